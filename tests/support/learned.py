"""Learned parameters for comparison, and trajectories of several seeds or some agents."""

import io
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import Trajectory

Arrays = dict[str, NDArray[Any]]


def tensors(state: Any, path: str = "") -> Arrays:  # noqa: ANN401 - tensors, nested
    """Return copies of all tensors of a nested state, by their place in it."""
    if isinstance(state, torch.Tensor):
        return {path.strip(): state.detach().cpu().numpy().copy()}
    if not isinstance(state, dict | list):
        return {}
    items = state.items() if isinstance(state, dict) else enumerate(state)
    return {name: value for key, part in items for name, value in tensors(part, f"{path} {key}").items()}


def assert_equal(got: Arrays, expected: Arrays) -> None:
    """Bit for bit."""
    assert got.keys() == expected.keys()
    for name, array in got.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)


def assert_close(got: Arrays, expected: Arrays, rtol: float = 1e-9, atol: float = 1e-10) -> None:
    assert got.keys() == expected.keys()
    for name, array in got.items():
        np.testing.assert_allclose(array, expected[name], rtol=rtol, atol=atol, err_msg=name)


def reloaded(state: dict[str, Any]) -> Any:  # noqa: ANN401 - as torch loads it
    """Return a state as it comes back from a checkpoint."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, map_location="cpu", weights_only=True)


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return trajectories side by side, as those of one stack of seeds."""
    names = [field.name for field in fields(Trajectory)]
    return Trajectory(*(np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names))


def of_agents(made: Trajectory, agents: slice) -> Trajectory:
    """Return the part of some agents; the states stay."""
    by_agent = {field.name for field in fields(Trajectory)} - {"states", "final_states"}
    return replace(made, **{name: getattr(made, name)[:, :, agents] for name in by_agent})

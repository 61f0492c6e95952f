"""Learned parameters for comparison, and trajectories of several seeds or some agents."""

import io
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from headway.contracts import EnvSpec, StartingLearner, Trajectory
from headway_algos.networks.mlp import StackedMLP
from headway_algos.registry import ENTRIES, configure

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


def starting_learner(
    algorithm: str,
    spec: EnvSpec,
    seeds: tuple[int, ...] = (3,),
    **settings: Any,  # noqa: ANN401 - hyper-parameters
) -> StartingLearner:
    """Return a learner that can start from a rule or another run."""
    learner = ENTRIES[algorithm].learner(configure(algorithm, **settings), spec, seeds, "cpu")
    assert isinstance(learner, StartingLearner)
    return learner


def alone(stacked: StackedMLP, p: int) -> nn.Sequential:
    """Return network p of a stack as a plain one, with copies of its parameters."""
    layers: list[nn.Module] = []
    for weight, bias in zip(stacked.weights, stacked.biases, strict=True):
        linear = nn.Linear(weight.shape[2], weight.shape[1], dtype=weight.dtype)
        linear.weight.data, linear.bias.data = weight.data[p].clone(), bias.data[p, :, 0].clone()
        layers += [linear, nn.Tanh() if stacked.activation == "tanh" else nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return trajectories side by side, as those of one stack of seeds."""
    names = [field.name for field in fields(Trajectory)]
    return Trajectory(*(np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names))


def of_agents(made: Trajectory, agents: slice) -> Trajectory:
    """Return the part of some agents; the states stay."""
    of_copies = {"states", "final_states", "episode_ended", "episode_begins"}
    by_agent = {field.name for field in fields(Trajectory)} - of_copies
    return replace(made, **{name: getattr(made, name)[:, :, agents] for name in by_agent})

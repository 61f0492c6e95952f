"""The stack of policies that a learner trains: device, metrics per replica, and divergence check."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError
from headway_algos.config import LearnerConfig
from headway_algos.grouping import Grouping


def resolve_device(device: str) -> torch.device:
    """Return the torch device; `auto` is a GPU if available. Raises HeadwayError for an unavailable one."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise HeadwayError("device: cuda needs a GPU, and torch finds none; use device=auto or device=cpu")
    try:
        return torch.device(device)
    except RuntimeError:
        raise HeadwayError(f"device: {device!r} is not a device; use device=auto, cpu or cuda") from None


@dataclass(frozen=True)
class Stack:
    """P = R x K policies, replica-major."""

    grouping: Grouping
    spec: EnvSpec
    seeds: tuple[int, ...]
    """(R,): one per replica."""

    def raise_if_diverged(self, acting: Mapping[str, NDArray[Any]], config: LearnerConfig, when: str) -> None:
        """Raise HeadwayError, naming policy and seed, if acting parameters (P, ., .) are not all finite.

        `when`: for instance "iteration 7".
        """
        for array in acting.values():
            broken = ~np.isfinite(array).all(axis=(1, 2))
            if broken.any():
                replica, policy = divmod(int(broken.argmax()), self.grouping.num_policies)
                owner = self.grouping.owner(policy, self.spec)
                raise HeadwayError(
                    f"{config.name} diverged: the policy of {owner}, seed {self.seeds[replica]}, is not "
                    f"finite after {when}; {remedy(config)}"
                )


def remedy(config: LearnerConfig, of_critic: bool = False) -> str:
    """Return what to change when the policies or the critic diverge, in keys that the algorithm has."""
    values = {key.name: getattr(config, key.name) for key in fields(config)}
    names = ["lr", "kl_bound"]
    if of_critic:
        names = ["lr" if values.get("critic_lr") is None else "critic_lr", "critic_kl_bound"]
    clipped = values.get("grad_clip") is not None
    lower = " or ".join(f"algo.{name}" for name in [*names, *["grad_clip"] * clipped] if name in values)
    unbounded = "grad_clip" in values and not clipped
    return f"lower {lower}" + (", or bound the gradients by algo.grad_clip" if unbounded else "")


def mean_per_replica(values: Tensor, replicas: int) -> NDArray[np.float64]:
    """Return the mean over each replica's networks, (R,), of values (P,).

    NaN, of networks that took no step, is left out; the mean is NaN if there is nothing else.
    """
    table = values.double().cpu().numpy().reshape(replicas, -1)
    known = ~np.isnan(table)
    count = known.sum(axis=1)
    total = np.where(known, table, 0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)

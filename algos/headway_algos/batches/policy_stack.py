"""The stack of policies that a learner trains: device, metrics per replica, and divergence check."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError
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

    def per_replica(self, values: Tensor) -> NDArray[np.float64]:
        """Return the mean over each replica's networks, (R,), of values (P,)."""
        means: NDArray[np.float64] = values.double().cpu().numpy().reshape(len(self.seeds), -1).mean(axis=1)
        return means

    def raise_if_diverged(
        self, acting: Mapping[str, NDArray[Any]], algorithm: str, iteration: int, advice: str
    ) -> None:
        """Raise HeadwayError, naming policy and seed, if acting parameters (P, ., .) are not all finite."""
        for array in acting.values():
            broken = ~np.isfinite(array).all(axis=(1, 2))
            if broken.any():
                replica, policy = divmod(int(broken.argmax()), self.grouping.num_policies)
                owner = self.grouping.owner(policy, self.spec)
                raise HeadwayError(
                    f"{algorithm} diverged: the policy of {owner}, seed {self.seeds[replica]}, is not finite "
                    f"after iteration {iteration}; {advice}, or bound the gradients by algo.grad_clip"
                )

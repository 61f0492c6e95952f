"""What learners of every kind need to know of the stack of policies that they improve."""

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
    """`auto` is a GPU if torch sees one; raises HeadwayError for a device that is not there."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise HeadwayError("device: cuda was asked for, but torch sees no GPU; use device=auto or device=cpu")
    try:
        return torch.device(device)
    except RuntimeError:
        raise HeadwayError(f"device: {device!r} is no device; use device=auto, cpu or cuda") from None


@dataclass(frozen=True)
class Stack:
    """P = R x K policies: those of replica r stand from r K on."""

    grouping: Grouping
    spec: EnvSpec
    seeds: tuple[int, ...]
    """(R,): of the replicas."""

    def per_replica(self, values: Tensor) -> NDArray[np.float64]:
        """(P,) -> (R,): the mean over a replica's networks."""
        means: NDArray[np.float64] = values.double().cpu().numpy().reshape(len(self.seeds), -1).mean(axis=1)
        return means

    def raise_if_diverged(
        self, acting: Mapping[str, NDArray[Any]], algorithm: str, iteration: int, advice: str
    ) -> None:
        """Raise HeadwayError where acting parameters (P, ., .) are no longer finite: workers would act on
        them all the same."""
        for array in acting.values():
            broken = ~np.isfinite(array).all(axis=(1, 2))
            if broken.any():
                replica, policy = divmod(int(broken.argmax()), self.grouping.num_policies)
                owner = self.grouping.owner(policy, self.spec)
                raise HeadwayError(
                    f"{algorithm} diverged: the policy of {owner}, seed {self.seeds[replica]}, is not finite "
                    f"after iteration {iteration}; {advice}, or bound the gradients by algo.grad_clip"
                )

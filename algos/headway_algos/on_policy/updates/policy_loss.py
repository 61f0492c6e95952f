"""The loss of a policy: a pure function, which torch differentiates."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from headway_algos.networks.distributions import Distribution


@dataclass(frozen=True)
class Minibatch:
    """Rows that a policy loss needs, B for each of P policies."""

    actions: Tensor
    """(P, B) of Discrete actions, (P, B, A) of Box ones."""
    log_probs: Tensor
    """(P, B): of these actions, by the policies that acted."""
    advantages: Tensor
    """(P, B)"""


class PolicyLoss(Protocol):
    """Loss of a policy by row: minimised by `GradientUpdate`, differentiated by `KFAC` and `TRPO`."""

    @property
    def reports(self) -> tuple[str, ...]:
        """Names of the metrics that the loss returns."""
        ...

    def __call__(self, new: Distribution, batch: Minibatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of each row and the metrics by name, (P, B) each.

        `new` are the current action distributions at these rows. Callers take means over each policy's rows.
        """
        ...

"""The loss of a policy: a pure function, which torch differentiates."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from headway_algos.networks.distributions import Distribution


@dataclass(frozen=True)
class Minibatch:
    """Rows that P policies learn from at once, B each."""

    actions: Tensor
    """(P, B) of Discrete actions, (P, B, A) of Box ones."""
    log_probs: Tensor
    """(P, B): of these actions, by the policies that acted."""
    advantages: Tensor
    """(P, B)"""


class PolicyLoss(Protocol):
    """What `GradientUpdate` descends."""

    @property
    def reports(self) -> tuple[str, ...]:
        """Names of the numbers that are reported beside the loss."""
        ...

    def __call__(self, new: Distribution, batch: Minibatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of each row (P, B), and the reported numbers by name, (P, B) each.

        `new` are the distributions of the policies as they are now, at the rows of the minibatch. What is
        minimised, and reported, is the mean over a policy's rows.
        """
        ...

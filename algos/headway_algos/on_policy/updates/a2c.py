"""The loss of the advantage actor-critic (Mnih et al. 2016, arXiv:1602.01783, section 4)."""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from headway_algos.networks.distributions import Distribution
from headway_algos.on_policy.updates.policy_loss import Minibatch


@dataclass(frozen=True)
class A2C:
    """The policy gradient with an entropy bonus, -log pi(u|o) A - entropy_coeff H; see `PolicyLoss`.

    `compiled_losses` selects kernels with the same gradients on a CPU: change both.
    """

    entropy_coeff: float

    reports: ClassVar[tuple[str, ...]] = ("entropy",)

    def __call__(self, new: Distribution, batch: Minibatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss and the entropy."""
        entropy = new.entropy()
        loss = -new.log_prob(batch.actions) * batch.advantages - self.entropy_coeff * entropy
        return loss, {"entropy": entropy}

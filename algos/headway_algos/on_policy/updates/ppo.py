"""The loss of proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347)."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from headway_algos.networks.distributions import Distribution
from headway_algos.on_policy.updates.policy_loss import Minibatch


@dataclass(frozen=True)
class PPO:
    """The clipped surrogate with an entropy bonus; see `PolicyLoss`.

    With r = pi(u|o) / pi_old(u|o): -min(r A, clip(r, 1 - clip, 1 + clip) A) - entropy_coeff H(pi(.|o)).
    `compiled_losses` selects kernels with the same gradients on a CPU: change both.
    """

    clip: float
    entropy_coeff: float

    reports: ClassVar[tuple[str, ...]] = ("kl", "entropy", "clip_fraction")

    def __call__(self, new: Distribution, batch: Minibatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss; an estimate of the KL divergence, the entropy and whether the ratio is clipped."""
        log_ratio = new.log_prob(batch.actions) - batch.log_probs
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        surrogate = torch.minimum(ratio * batch.advantages, clipped * batch.advantages)  # equation 7
        entropy = new.entropy()
        loss = -surrogate - self.entropy_coeff * entropy
        return loss, {
            # Schulman's estimate of low variance, http://joschu.net/blog/kl-approx.html
            "kl": ratio - 1 - log_ratio,
            "entropy": entropy,
            "clip_fraction": ((ratio - 1).abs() > self.clip).to(ratio),
        }

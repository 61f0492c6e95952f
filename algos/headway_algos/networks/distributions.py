"""Action distributions of stacked policies, with the action axis second: (P, A, B).

Tested to equal torch.distributions; these skip its argument checks and keep rows contiguous.
"""

from dataclasses import dataclass
from math import log, pi
from typing import ClassVar, Self

import torch
from torch import Tensor


@dataclass(frozen=True)
class MaskedCategorical:
    """Normalised log-probabilities (P, A, B); forbidden actions have probability exactly 0."""

    log_probs: Tensor
    allowed: Tensor | None
    """(P, A, B) bool, or None if every action is allowed."""

    @classmethod
    def of_logits(cls, logits: Tensor, masks: Tensor | None) -> Self:
        """Return the distributions of logits (P, A, B) under action masks (P, B, A)."""
        if masks is None:
            return cls(torch.log_softmax(logits, dim=1), None)
        allowed = masks.transpose(1, 2)
        # A large negative number avoids 0 x inf in gradients, unlike -inf; its exponential is exactly 0.
        masked = logits.masked_fill(~allowed, torch.finfo(logits.dtype).min / 4)
        return cls(torch.log_softmax(masked, dim=1), allowed)

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return log p(u), (P, B), of actions (P, B) int64."""
        return self.log_probs.gather(1, actions[:, None])[:, 0]

    def _expectation(self, values: Tensor) -> Tensor:
        terms = self.log_probs.exp() * values
        if self.allowed is not None:
            terms = terms.masked_fill(~self.allowed, 0)
        return terms.sum(1)

    def entropy(self) -> Tensor:
        """Return -sum p log p over the allowed actions, (P, B)."""
        return -self._expectation(self.log_probs)

    def kl_from(self, old: Self) -> Tensor:
        """Return KL(old || self) = sum p_old (log p_old - log p), (P, B)."""
        return old._expectation(old.log_probs - self.log_probs)

    def slopes(
        self,
        actions: Tensor,
        of_log_prob: Tensor,
        of_entropy: Tensor,
        penalty: tuple[Self, Tensor] | None = None,
    ) -> tuple[Tensor, None]:
        """Return d sum(a log p(u) + b H + c KL(old || self)) / d logits, (P, A, B), and None.

        Coefficients a = `of_log_prob` and b = `of_entropy` are (P, B); `penalty` is (old, c), or None for
        c = 0. The second result stands for the gradient of a Gaussian's log standard deviation.
        """
        probabilities = self.log_probs.exp()
        surprise = self.log_probs + self.entropy()[:, None]
        slope = -probabilities * (of_log_prob[:, None] + of_entropy[:, None] * surprise)
        slope.scatter_add_(1, actions[:, None], of_log_prob[:, None])
        if penalty is not None:
            old, of_kl = penalty
            slope += of_kl[:, None] * (probabilities - old.log_probs.exp())
        if self.allowed is not None:
            slope.masked_fill_(~self.allowed, 0)
        return slope, None

    def detach(self) -> Self:
        """Return the distribution detached from the autograd graph."""
        return type(self)(self.log_probs.detach(), self.allowed)

    def fisher_of_outputs(self, direction: Tensor) -> Tensor:
        """Return (diag(p) - p p^T) v, (P, A, B): the Fisher information in the logits, times v."""
        probabilities = self.log_probs.exp()
        weighted = probabilities * direction
        return weighted - probabilities * weighted.sum(1, keepdim=True)

    def drawn_score(self, noise: Tensor) -> Tensor:
        """Return d log p(u) / d logits, (P, A, B): one-hot(u) - p, for u drawn by uniforms (P, B) float64."""
        cumulative = self.log_probs.double().exp().cumsum(1)
        chosen = (cumulative <= noise[:, None] * cumulative[:, -1:]).sum(1, keepdim=True)
        actions = torch.arange(cumulative.shape[1], device=chosen.device)[None, :, None]
        return (actions == chosen).to(self.log_probs.dtype) - self.log_probs.exp()


@dataclass(frozen=True)
class DiagonalGaussian:
    """Gaussians with mean (P, A, B) and a log standard deviation (P, A, 1) independent of the state."""

    LOG_STD_FISHER: ClassVar[float] = 2.0
    """Fisher information of each log standard deviation; its off-diagonal entries are 0."""

    mean: Tensor
    log_std: Tensor

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return the log-density (P, B) of actions (P, B, A)."""
        standard = (actions.transpose(1, 2) - self.mean) * torch.exp(-self.log_std)
        return (-0.5 * standard**2 - self.log_std - 0.5 * log(2 * pi)).sum(1)

    def entropy(self) -> Tensor:
        """Return the entropy (P, B), the same for every row of a policy."""
        entropy = (self.log_std + 0.5 * log(2 * pi) + 0.5).sum(1)
        return entropy.expand(-1, self.mean.shape[2])

    def kl_from(self, old: Self) -> Tensor:
        """Return KL(old || self), (P, B)."""
        variance_ratio = torch.exp(2 * (old.log_std - self.log_std))
        distance = ((old.mean - self.mean) * torch.exp(-self.log_std)) ** 2
        return (0.5 * (variance_ratio + distance - 1) + self.log_std - old.log_std).sum(1)

    def slopes(
        self,
        actions: Tensor,
        of_log_prob: Tensor,
        of_entropy: Tensor,
        penalty: tuple[Self, Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return d sum(a log p(u) + b H + c KL(old || self)) / d mean, (P, A, B), and / d log_std, (P, A, 1).

        Coefficients a = `of_log_prob` and b = `of_entropy` are (P, B), actions u (P, B, A); `penalty` is
        (old, c), or None for c = 0.
        """
        inverse = torch.exp(-self.log_std)
        standard = (actions.transpose(1, 2) - self.mean) * inverse
        weighted = of_log_prob[:, None] * standard
        of_mean, of_log_std = weighted, weighted * standard - of_log_prob[:, None] + of_entropy[:, None]
        if penalty is not None:
            old, of_kl = penalty
            shift = (self.mean - old.mean) * inverse
            variance_ratio = torch.exp(2 * (old.log_std - self.log_std))
            of_mean = of_mean + of_kl[:, None] * shift
            of_log_std += of_kl[:, None] * (1 - variance_ratio - shift.square())
        return of_mean * inverse, of_log_std.sum(2, keepdim=True)

    def detach(self) -> Self:
        """Return a detached copy, which later changes of the parameters leave unchanged."""
        return type(self)(self.mean.detach(), self.log_std.detach().clone())

    def fisher_of_outputs(self, direction: Tensor) -> Tensor:
        """Return v / variance, (P, A, B): the Fisher information in the mean, times v."""
        return direction * torch.exp(-2 * self.log_std.detach())

    def drawn_score(self, noise: Tensor) -> Tensor:
        """Return d log p(u) / d mean, (P, A, B), for actions u drawn by standard normals (P, B, A)."""
        return noise.transpose(1, 2).to(self.log_std.dtype) * torch.exp(-self.log_std)

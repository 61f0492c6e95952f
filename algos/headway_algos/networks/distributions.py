"""Action distributions of stacked policies, with the action axis second: (P, A, B).

Tests check them against torch.distributions. Unlike those, they do not validate arguments, and they keep rows
contiguous.
"""

from collections.abc import Iterable, Sequence
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

    def kl_from(self, old: "Distribution") -> Tensor:
        """Return KL(old || self) = sum p_old (log p_old - log p), (P, B)."""
        assert isinstance(old, MaskedCategorical)
        return old._expectation(old.log_probs - self.log_probs)

    def detach(self) -> Self:
        """Return the distribution detached from the autograd graph."""
        return type(self)(self.log_probs.detach(), self.allowed)

    def fisher_of_outputs(self, direction: Tensor) -> Tensor:
        """Return (diag(p) - p p^T) v, (P, A, B): the Fisher information in the logits, times v."""
        probabilities = self.log_probs.exp()
        weighted = probabilities * direction
        return weighted - probabilities * weighted.sum(1, keepdim=True)

    def drawn_score(self, noise: Tensor) -> Tensor:
        """Return d log p(u) / d logits, (P, A, B): one-hot(u) - p, u sampled with uniforms (P, B) float64."""
        cumulative = self.log_probs.double().exp().cumsum(1)
        chosen = (cumulative <= noise[:, None] * cumulative[:, -1:]).sum(1, keepdim=True)
        actions = torch.arange(cumulative.shape[1], device=chosen.device)[None, :, None]
        return (actions == chosen).to(self.log_probs.dtype) - self.log_probs.exp()


@dataclass(frozen=True)
class CategoricalProduct:
    """Independent categoricals, one per choice of a MultiDiscrete action; their outputs are concatenated."""

    choices: tuple[MaskedCategorical, ...]

    @classmethod
    def of_logits(cls, logits: Tensor, masks: Tensor | None, nvec: Sequence[int]) -> Self:
        """Return the distributions of logits (P, A, B) under action masks (P, B, A), A the sum of `nvec`."""
        parts = torch.split(logits, list(nvec), dim=1)
        allowed = [None] * len(parts) if masks is None else torch.split(masks, list(nvec), dim=2)
        return cls(tuple(map(MaskedCategorical.of_logits, parts, allowed)))

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return log p(u), (P, B), of actions (P, B, choices) int64."""
        return _sum(choice.log_prob(actions[..., i]) for i, choice in enumerate(self.choices))

    def entropy(self) -> Tensor:
        """Return the entropy (P, B): the sum over the choices."""
        return _sum(choice.entropy() for choice in self.choices)

    def kl_from(self, old: "Distribution") -> Tensor:
        """Return KL(old || self), (P, B): the sum over the choices."""
        assert isinstance(old, CategoricalProduct)
        return _sum(new.kl_from(before) for new, before in zip(self.choices, old.choices, strict=True))

    def detach(self) -> Self:
        """Return the distribution detached from the autograd graph."""
        return type(self)(tuple(choice.detach() for choice in self.choices))

    def fisher_of_outputs(self, direction: Tensor) -> Tensor:
        """Return the Fisher information in the logits times v, (P, A, B): one block per choice."""
        parts = torch.split(direction, [choice.log_probs.shape[1] for choice in self.choices], dim=1)
        return torch.cat([c.fisher_of_outputs(part) for c, part in zip(self.choices, parts, strict=True)], 1)

    def drawn_score(self, noise: Tensor) -> Tensor:
        """Return d log p(u) / d logits, (P, A, B), for u sampled with uniforms (P, B, choices) float64."""
        return torch.cat([choice.drawn_score(noise[..., i]) for i, choice in enumerate(self.choices)], dim=1)


def _sum(terms: Iterable[Tensor]) -> Tensor:
    return torch.stack(tuple(terms)).sum(0)


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

    def kl_from(self, old: "Distribution") -> Tensor:
        """Return KL(old || self), (P, B)."""
        assert isinstance(old, DiagonalGaussian)
        variance_ratio = torch.exp(2 * (old.log_std - self.log_std))
        distance = ((old.mean - self.mean) * torch.exp(-self.log_std)) ** 2
        return (0.5 * (variance_ratio + distance - 1) + self.log_std - old.log_std).sum(1)

    def detach(self) -> Self:
        """Return a detached copy, which later changes of the parameters leave unchanged."""
        return type(self)(self.mean.detach(), self.log_std.detach().clone())

    def fisher_of_outputs(self, direction: Tensor) -> Tensor:
        """Return v / variance, (P, A, B): the Fisher information in the mean, times v."""
        return direction * torch.exp(-2 * self.log_std.detach())

    def drawn_score(self, noise: Tensor) -> Tensor:
        """Return d log p(u) / d mean, (P, A, B), for actions u sampled with standard normals (P, B, A)."""
        return noise.transpose(1, 2).to(self.log_std.dtype) * torch.exp(-self.log_std)


Distribution = MaskedCategorical | CategoricalProduct | DiagonalGaussian
"""Action distribution of a stack of policies, by the kind of action space."""

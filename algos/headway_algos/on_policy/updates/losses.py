"""Losses of policies: pure functions, which torch differentiates."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from headway.contracts import HeadwayError
from headway_algos.networks.distributions import Distribution


@dataclass(frozen=True)
class LossRows:
    """Rows that a policy loss needs, B for each of P policies."""

    actions: Tensor
    """(P, B) of Discrete actions, (P, B, A) of Box ones."""
    log_probs: Tensor
    """(P, B): log-probabilities of the actions under the policies that acted."""
    advantages: Tensor
    """(P, B)"""


class PolicyLoss(Protocol):
    """Per-row loss of a policy, which an update differentiates.

    `GradientUpdate` takes any; `KFAC` takes `A2CLoss`, and `TRPO` `SurrogateLoss`.
    """

    @property
    def reports(self) -> tuple[str, ...]:
        """Names of the metrics that the loss returns."""
        ...

    def __call__(self, new: Distribution, batch: LossRows) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of each row and the metrics by name, (P, B) each.

        `new` are the current action distributions at these rows. Callers take means over each policy's rows.
        """
        ...


def require_reports(loss: PolicyLoss) -> None:
    """Raise HeadwayError unless `reports` is a tuple of names, not `gradient_norm`, which updates report."""
    name, reports = type(loss).__name__, getattr(loss, "reports", None)
    if not (isinstance(reports, tuple) and all(isinstance(metric, str) for metric in reports)):
        raise HeadwayError(
            f'{name}.reports must be a tuple of the names of its metrics, such as ("entropy",) or ()'
        )
    if "gradient_norm" in reports:
        raise HeadwayError(
            f"{name} reports gradient_norm, which the update reports; give its metric another name"
        )


def checked_loss(loss: PolicyLoss, new: Distribution, batch: LossRows) -> tuple[Tensor, Tensor]:
    """Return a loss per row (P, B) and the I metrics that it reports (I, P, B).

    Raises HeadwayError if the loss returns anything else: a mean, for instance, would mix policies and count
    rows of padding.
    """
    name, shape = type(loss).__name__, tuple(batch.log_probs.shape)
    returned: object = loss(new, batch)
    if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], dict)):
        raise HeadwayError(f"{name} must return a pair: the loss of each row, and a dict of metrics")
    values, metrics = returned
    if missing := [metric for metric in loss.reports if metric not in metrics]:
        raise HeadwayError(f"{name} reports {', '.join(missing)}, and must return it in its dict of metrics")
    for what, rows in (("its loss", values), *((metric, metrics[metric]) for metric in loss.reports)):
        if not isinstance(rows, Tensor):
            raise HeadwayError(
                f"{name} must return tensors of torch, and {what} is of type {type(rows).__name__}"
            )
        if tuple(rows.shape) != shape:
            raise HeadwayError(
                f"{name} must return one value per row, of shape (policies, rows) = {shape} here, and {what} "
                f"has shape {tuple(rows.shape)}; leave out means and sums, which the update takes"
            )
    if not values.requires_grad:
        raise HeadwayError(f"{name} has no gradient: it must depend on the distributions `new`, not detached")
    reported = [metrics[metric].detach() for metric in loss.reports]
    return values, torch.stack(reported) if reported else values.new_zeros(0, *shape)


@dataclass(frozen=True)
class PPOLoss:
    """Proximal policy optimisation: the clipped surrogate with an entropy bonus.

    With r = pi(u|o) / pi_old(u|o): -min(r A, clip(r, 1 - clip, 1 + clip) A) - entropy_coeff H(pi(.|o))
    (Schulman et al. 2017, arXiv:1707.06347). On a CPU, `kernels.minibatch_steps` computes the same gradients;
    a change here needs one there.
    """

    clip: float
    entropy_coeff: float

    reports: ClassVar[tuple[str, ...]] = ("kl", "entropy", "clip_fraction")

    def __call__(self, new: Distribution, batch: LossRows) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss, and as metrics a KL estimate, the entropy and whether the ratio is clipped."""
        log_ratio = new.log_prob(batch.actions) - batch.log_probs
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        surrogate = torch.minimum(ratio * batch.advantages, clipped * batch.advantages)  # equation 7
        entropy = new.entropy()
        loss = -surrogate - self.entropy_coeff * entropy
        return loss, {
            # Schulman's low-variance estimate, http://joschu.net/blog/kl-approx.html
            "kl": ratio - 1 - log_ratio,
            "entropy": entropy,
            "clip_fraction": ((ratio - 1).abs() > self.clip).to(ratio),
        }


@dataclass(frozen=True)
class A2CLoss:
    """Advantage actor-critic: the policy gradient with an entropy bonus, -log pi(u|o) A - entropy_coeff H.

    Source: Mnih et al. 2016, arXiv:1602.01783, section 4. On a CPU, `kernels.minibatch_steps` computes the
    same gradients; a change here needs one there.
    """

    entropy_coeff: float

    reports: ClassVar[tuple[str, ...]] = ("entropy",)

    def __call__(self, new: Distribution, batch: LossRows) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss and the entropy."""
        entropy = new.entropy()
        loss = -new.log_prob(batch.actions) * batch.advantages - self.entropy_coeff * entropy
        return loss, {"entropy": entropy}

"""Trust-region policy optimisation of a stack of policies (Schulman et al. 2015, arXiv:1502.05477)."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import Distribution
from headway_algos.on_policy.updates.losses import LossRows
from headway_algos.on_policy.updates.natural_config import TRPOConfig
from headway_algos.optim.conjugate_gradient import conjugate_gradient
from headway_algos.optim.fisher import fisher_product, from_vector, to_vector


@dataclass(frozen=True)
class SurrogateLoss:
    """TRPO's surrogate, negative: -r A - entropy_coeff H(pi(.|o)), with r = pi(u|o) / pi_old(u|o).

    Source: Schulman et al. 2015, arXiv:1502.05477, equation 14, with an entropy bonus.
    """

    entropy_coeff: float

    reports: ClassVar[tuple[str, ...]] = ("entropy",)

    def __call__(self, new: Distribution, batch: LossRows) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss and the entropy."""
        ratio = (new.log_prob(batch.actions) - batch.log_probs).exp()
        entropy = new.entropy()
        return -ratio * batch.advantages - self.entropy_coeff * entropy, {"entropy": entropy}


class TRPO:
    """One natural-gradient step on the surrogate within a trust region, over the whole batch.

    The surrogate is L = E[pi / pi_old A] + entropy_coeff H with gradient g. Conjugate gradient solves F x = g
    for the damped Fisher information F; the step is sqrt(2 delta / x^T F x) x, halved until the mean
    KL(pi_old || pi) is at most delta and L rises by at least `accept_ratio` of its first-order expectation
    (appendix C). The line search is per policy; a policy that accepts no step stays exactly unchanged. As in
    the author's code, damping also enters the step length, which bounds the step where F vanishes.
    """

    def __init__(self, actor: Actor, config: TRPOConfig, layout: Layout) -> None:
        self.actor, self.config, self.share = actor, config, 1.0
        self.loss = SurrogateLoss(config.entropy_coeff)

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Take one step; `generators` are not used.

        Metrics are NaN for policies without rows. `kl` is the mean KL divergence of the step, and
        `accepted_step` the share of the full step that was taken, 0 if none was accepted.
        """
        actor, config = self.actor, self.config
        batch = WholeBatch.of(rows, advantages)
        gradient, surrogate, entropy, batch = self._gradient(batch)
        fisher_rows = batch.strided(round(1 / config.fisher_share))
        fisher = fisher_product(actor, fisher_rows, config.piece_samples)

        def damped(vector: Tensor) -> Tensor:
            return fisher(vector) + config.cg_damping * vector

        solution, image = conjugate_gradient(damped, gradient, config.cg_iterations)
        curvature = (solution * image).sum(1, keepdim=True)
        # A step is proportional to the root of its bound, so this multiplies the step by `share`.
        bound = config.kl_bound * self.share**2
        step = torch.where(curvature > 0, (2 * bound / curvature).sqrt() * solution, 0)
        info = self._search(batch, surrogate, step, (step * gradient).sum(1), bound)
        norm = gradient.square().sum(1).sqrt()
        metrics = {"entropy": entropy, "gradient_norm": norm, **info}
        return {name: batch.where_rows(values) for name, values in metrics.items()}

    def _gradient(self, batch: WholeBatch) -> tuple[Tensor, Tensor, Tensor, WholeBatch]:
        """Return the surrogate's gradient (P, V) and value (P,), entropy (P,), and the batch with outputs."""
        parameters, stack = self.actor.learnable, len(batch.weight)
        gradient = torch.zeros_like(to_vector(parameter.detach() for parameter in parameters))
        surrogate, entropy = gradient.new_zeros(stack), gradient.new_zeros(stack)
        kept: list[Tensor] = []
        for piece in batch.pieces(self.config.piece_samples):
            outputs = self.actor.network(piece.observations, piece.timeline)
            values, entropies = self._surrogate(self.actor, outputs, piece)
            gradient += to_vector(torch.autograd.grad(values.sum(), parameters))
            surrogate += values.detach()
            entropy += entropies.detach()
            kept.append(outputs.detach().transpose(1, 2))
        return gradient, surrogate, entropy, batch.with_outputs(kept)

    def _surrogate(self, actor: Actor, outputs: Tensor, piece: WholeBatch) -> tuple[Tensor, Tensor]:
        """Return a piece's share of the surrogate and of the mean entropy, (P,) each."""
        batch = LossRows(piece.actions, piece.log_probs, piece.advantages)
        loss, info = self.loss(actor.distribution(outputs, piece.masks), batch)
        return -(loss * piece.weight).sum(1), (info["entropy"] * piece.weight).sum(1)

    def _search(
        self,
        batch: WholeBatch,
        surrogate: Tensor,
        step: Tensor,
        expected: Tensor,
        bound: float,
    ) -> dict[str, Tensor]:
        """Halve each policy's step (P, V) until it is accepted, then apply it; return metrics (P,)."""
        kl, accepted = torch.zeros_like(surrogate), torch.zeros_like(surrogate)
        # Without an expected gain, as for policies without rows, there is nothing to search.
        searching = torch.nonzero(expected > 0)[:, 0]
        for halving in range(self.config.line_search_steps + 1):
            if len(searching) == 0:
                break
            size = 0.5**halving
            # On copies, so that a policy that accepts no step keeps its parameters to the last bit.
            after = self.actor.narrow(searching)
            log_std = None if self.actor.log_std is None else self.actor.log_std.detach()[searching]
            with torch.no_grad():
                changes = from_vector(size * step[searching], after.learnable)
                for tensor, change in zip(after.learnable, changes, strict=True):
                    tensor.add_(change)
                rows = batch if len(searching) == len(step) else batch.narrow(searching)
                new_surrogate, new_kl = self._compare(after, log_std, rows)
            least_gain = self.config.accept_ratio * size * expected[searching]
            accepts = (new_surrogate - surrogate[searching] >= least_gain) & (new_kl <= bound)
            self.actor.adopt(searching[accepts], after.narrow(accepts))
            kl[searching[accepts]], accepted[searching[accepts]] = new_kl[accepts], size
            searching = searching[~accepts]
        return {"kl": kl, "accepted_step": accepted}

    def _compare(self, after: Actor, log_std: Tensor | None, batch: WholeBatch) -> tuple[Tensor, Tensor]:
        """Return the surrogate of `after`, and its mean KL divergence from the policies before, (P,) each.

        The policies before have the batch's outputs and, with Box actions, log standard deviations `log_std`
        (P, A, 1).
        """
        surrogate, kl = batch.weight.new_zeros(len(batch.weight)), batch.weight.new_zeros(len(batch.weight))
        for piece in batch.pieces(self.config.piece_samples):
            assert piece.outputs is not None
            outputs = after.network(piece.observations, piece.timeline)
            surrogate += self._surrogate(after, outputs, piece)[0]
            old = after.distribution(piece.outputs.transpose(1, 2), piece.masks, log_std)
            new = after.distribution(outputs, piece.masks)
            kl += (new.kl_from(old) * piece.weight).sum(1)
        return surrogate, kl

    def anneal(self, share: float) -> None:
        """Scale steps to `share` of their configured size: the KL bound is multiplied by its square."""
        self.share = share

    def narrow(self, policies: Tensor) -> Self:
        """Return this update for copies of `policies` (n,)."""
        part = copy(self)
        part.actor = self.actor.narrow(policies)
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy the parameters of `policies` (n,) from `part`, a result of `narrow`."""
        self.actor.adopt(policies, part.actor)

    def state_dict(self) -> dict[str, Any]:
        """Return an empty state."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing: the state is empty."""

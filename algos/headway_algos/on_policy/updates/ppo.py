"""Proximal policy optimisation of a stack of policies (Schulman et al. 2017, arXiv:1707.06347)."""

from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.layout import Layout, Piece, even_slices
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.sequences import learning_batches, over_rows
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.passes import forward_pass
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.fast_path import surrogate, uncut


def slope_of_surrogate(ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """Return d min(r A, clip(r, 1 - clip, 1 + clip) A) / d log r (equation 7), elementwise.

    It is r A, or 0 where the clipped term is the minimum.
    """
    gained = ratio * advantages
    return torch.where(gained > ratio.clamp(1 - clip, 1 + clip) * advantages, 0, gained)


def _network_outputs(actor: Actor, rows: PolicyBatch, config: AlgoConfig) -> Tensor:
    """Return the network outputs (P, B, A) of all rows."""
    if rows.sequences is not None:
        return over_rows(actor.network, rows.observations, rows.sequences, config.piece_samples)
    with torch.no_grad():
        pieces = even_slices(rows.observations.shape[1], len(rows.observations), config.piece_samples)
        outputs = torch.cat([actor.network(rows.observations[:, piece]) for piece in pieces], dim=2)
        return outputs.transpose(1, 2).contiguous()


class PPO:
    """Epochs of minibatch steps on the clipped surrogate with KL penalty and entropy bonus."""

    def __init__(self, actor: Actor, config: AlgoConfig, layout: Layout) -> None:
        self.actor, self.config, self.layout = actor, config, layout
        self.optimiser = StackedAdam(actor.learnable, config.lr, config.grad_clip)
        policies = layout.replicas * layout.grouping.num_policies
        self.kl_coeff = torch.full((policies,), config.kl_coeff, device=layout.device, dtype=layout.dtype)

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Take the minibatch steps; `generators` shuffle the rows."""
        actor, config, layout = self.actor, self.config, self.layout
        penalised = config.kl_coeff > 0
        old_outputs = _network_outputs(actor, rows, config) if penalised else None
        old_log_std = actor.log_std.detach().clone() if actor.log_std is not None else None
        compiled = surrogate(
            actor, self.optimiser, rows, advantages, (old_outputs, old_log_std), self.kl_coeff, config
        )
        learn = compiled or partial(
            self._learn, rows=rows, advantages=advantages, old_outputs=old_outputs, old_log_std=old_log_std
        )
        cut = uncut(config) if compiled else config
        totals = torch.zeros(4, len(self.kl_coeff), device=layout.device, dtype=layout.dtype)
        shares, norms = totals[:3], totals[3]
        steps = np.zeros(len(self.kl_coeff))
        for pieces, active in learning_batches(rows.selected, rows.sequences, generators, cut, layout):
            self.optimiser.begin()
            for piece in pieces:
                shares += learn(piece)
            norms += self.optimiser.step(active)
            steps += active
        kl, entropy, clipped, norm = totals / torch.from_numpy(steps).to(totals).clamp(min=1)
        info = {"kl": kl, "entropy": entropy, "clip_fraction": clipped, "gradient_norm": norm}
        if penalised:
            info["kl"] = _mean_kl(actor, rows, old_outputs, old_log_std, config)
            info["kl_coeff"] = self.kl_coeff
            has_rows = torch.from_numpy(rows.selected.any(axis=1)).to(layout.device)
            new = adapted(self.kl_coeff, info["kl"], config.kl_target)
            self.kl_coeff = torch.where(has_rows, new, self.kl_coeff)
        return info

    def _learn(
        self,
        piece: Piece,
        rows: PolicyBatch,
        advantages: Tensor,
        old_outputs: Tensor | None,
        old_log_std: Tensor | None,
    ) -> Tensor:
        """Add a piece's gradients; return its shares of mean KL, entropy and clip fraction, (3, P).

        The KL divergence is an estimate, replaced by the exact value with a KL penalty.
        """
        actor, config, weight = self.actor, self.config, piece.weight
        masks = piece.of(rows.masks) if rows.masks is not None else None
        actions, advantage = piece.of(rows.actions), piece.of(advantages)
        passed = forward_pass(actor.network, piece.of(rows.observations), piece.timeline)
        with torch.no_grad():
            distribution = actor.distribution(passed.outputs, masks)
            log_ratio = distribution.log_prob(actions) - piece.of(rows.log_probs)
            ratio = log_ratio.exp()
            penalty = None
            if old_outputs is not None:
                old = actor.distribution(piece.of(old_outputs).transpose(1, 2), masks, old_log_std)
                penalty = (old, self.kl_coeff[:, None] * weight)
            slopes = distribution.slopes(
                actions,
                -weight * slope_of_surrogate(ratio, advantage, config.clip),
                -config.entropy_coeff * weight,
                penalty,  # type: ignore[arg-type]  # both of one kind
            )
            actor.send_back(passed, slopes)
            # Schulman's low-variance estimator, http://joschu.net/blog/kl-approx.html.
            kl = ratio - 1 - log_ratio
            clipped = ((ratio - 1).abs() > config.clip).to(weight)
            return (torch.stack([kl, distribution.entropy(), clipped]) * weight).sum(2)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its configured value."""
        self.optimiser.anneal(share)

    def narrow(self, policies: Tensor) -> Self:
        """Return this update for copies of `policies` (n,)."""
        part = copy(self)
        part.actor = self.actor.narrow(policies)
        part.optimiser = self.optimiser.narrow(policies, part.actor.learnable)
        part.kl_coeff = self.kl_coeff[policies]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy `policies` (n,), their optimiser state and KL coefficients from `part`."""
        self.actor.adopt(policies, part.actor)
        self.optimiser.adopt(policies, part.optimiser)
        self.kl_coeff = self.kl_coeff.index_copy(0, policies, part.kl_coeff)

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state and the KL coefficients."""
        return {"optimiser": self.optimiser.state_dict(), "kl_coeff": self.kl_coeff}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.kl_coeff = state["kl_coeff"].to(self.layout.device)


def adapted(kl_coeff: Tensor, kl: Tensor, target: float) -> Tensor:
    """Return the next KL coefficients (P,), given the mean KL (P,): section 4 of the paper, with RLlib's
    factors."""
    kl_coeff = torch.where(kl > 2 * target, kl_coeff * 1.5, kl_coeff)
    return torch.where(kl < target / 2, kl_coeff * 0.5, kl_coeff)


def _mean_kl(
    actor: Actor,
    rows: PolicyBatch,
    old_outputs: Tensor | None,
    old_log_std: Tensor | None,
    config: AlgoConfig,
) -> Tensor:
    """Return the mean KL(old || new) of each policy over its selected rows, (P,)."""
    assert old_outputs is not None
    selected = torch.from_numpy(rows.selected).to(old_outputs.device)
    total = torch.zeros(len(selected), device=old_outputs.device, dtype=old_outputs.dtype)
    parts = [slice(None)]
    if rows.sequences is None:
        parts = even_slices(selected.shape[1], len(selected), config.piece_samples)
    new_outputs = _network_outputs(actor, rows, config).transpose(1, 2)
    with torch.no_grad():
        for part in parts:
            masks = rows.masks[:, part] if rows.masks is not None else None
            new = actor.distribution(new_outputs[:, :, part], masks)
            old = actor.distribution(old_outputs[:, part].transpose(1, 2), masks, old_log_std)
            kl = new.kl_from(old)  # type: ignore[arg-type]  # both of one kind
            total += torch.where(selected[:, part], kl, 0).sum(1)
    return total / selected.sum(1).clamp(min=1)

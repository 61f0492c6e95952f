"""Gradient steps down a policy's loss, for a stack of policies."""

from collections.abc import Sequence
from copy import copy
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.layout import Layout, Piece, even_slices
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.sequences import learning_batches, over_rows
from headway_algos.config import AlgoConfig
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.compiled_losses import compiled_loss
from headway_algos.on_policy.updates.policy_loss import Minibatch, PolicyLoss
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.gradient_steps import gradient_steps


class GradientUpdate:
    """Epochs of minibatch steps by Adam down the mean of a `PolicyLoss`; see `Update`.

    With a KL coefficient c above 0, c KL(pi_old || pi) joins the loss; after each improvement c is adapted
    to the divergence that resulted (Schulman et al. 2017, arXiv:1707.06347, section 4).
    """

    def __init__(
        self,
        actor: Actor,
        config: AlgoConfig,
        layout: Layout,
        loss: PolicyLoss,
        epochs: int = 1,
        minibatches: int = 1,
        kl_coeff: float = 0.0,
    ) -> None:
        self.actor, self.config, self.layout, self.loss = actor, config, layout, loss
        self.epochs, self.minibatches = epochs, minibatches
        self.optimiser = StackedAdam(actor.learnable, config.lr, config.grad_clip)
        self.penalised = kl_coeff > 0
        policies = layout.replicas * layout.grouping.num_policies
        self.kl_coeff = torch.full((policies,), kl_coeff, device=layout.device, dtype=layout.dtype)

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """See `headway_algos.on_policy.updates.Update`."""
        old_outputs = _network_outputs(self.actor, rows, self.config) if self.penalised else None
        old_log_std = self.actor.log_std.detach().clone() if self.actor.log_std is not None else None
        old = (old_outputs, old_log_std)

        def learn(piece: Piece) -> Tensor:
            return self._learn(piece, rows, advantages, old)

        compiled = compiled_loss(self.loss, self.actor, self.optimiser, rows, advantages, old, self.kl_coeff)
        batches = learning_batches(
            rows.selected, rows.sequences, generators, self.epochs, self.minibatches,
            None if compiled else self.config.piece_samples, self.layout,
        )  # fmt: skip
        reported, norm = gradient_steps(self.optimiser, batches, compiled or learn, len(self.loss.reports))
        info = dict(zip(self.loss.reports, reported, strict=True)) | {"gradient_norm": norm}
        if self.penalised:
            info["kl"] = _mean_kl(self.actor, rows, old, self.config)
            info["kl_coeff"] = self.kl_coeff
            has_rows = torch.from_numpy(rows.selected.any(axis=1)).to(self.layout.device)
            new = adapted_kl_coeff(self.kl_coeff, info["kl"], self.config.kl_target)
            self.kl_coeff = torch.where(has_rows, new, self.kl_coeff)
        return info

    def _learn(
        self, piece: Piece, rows: PolicyBatch, advantages: Tensor, old: tuple[Tensor | None, Tensor | None]
    ) -> Tensor:
        """Add a piece's gradients by autograd; return its shares of the reported numbers, (I, P)."""
        masks = None if rows.masks is None else piece.of(rows.masks)
        new = self.actor(piece.of(rows.observations), masks, piece.timeline)
        batch = Minibatch(piece.of(rows.actions), piece.of(rows.log_probs), piece.of(advantages))
        loss, info = self.loss(new, batch)
        old_outputs, old_log_std = old
        if old_outputs is not None:
            before = self.actor.distribution(piece.of(old_outputs).transpose(1, 2), masks, old_log_std)
            loss = loss + self.kl_coeff[:, None] * new.kl_from(before)
        torch.autograd.backward((loss * piece.weight).sum())
        reported = torch.stack([info[name] for name in self.loss.reports]).detach()
        return (reported * piece.weight).sum(2)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its base."""
        self.optimiser.anneal(share)

    def narrow(self, policies: Tensor) -> Self:
        """See `headway_algos.on_policy.updates.Update`."""
        part = copy(self)
        part.actor = self.actor.narrow(policies)
        part.optimiser = self.optimiser.narrow(policies, part.actor.learnable)
        part.kl_coeff = self.kl_coeff[policies]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """See `headway_algos.on_policy.updates.Update`."""
        self.actor.adopt(policies, part.actor)
        self.optimiser.adopt(policies, part.optimiser)
        self.kl_coeff = self.kl_coeff.index_copy(0, policies, part.kl_coeff)

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state and the KL coefficients."""
        return {"optimiser": self.optimiser.state_dict(), "kl_coeff": self.kl_coeff}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.optimiser.load_state_dict(state["optimiser"])
        if "kl_coeff" in state:  # checkpoints of A2C once had none
            self.kl_coeff = state["kl_coeff"].to(self.layout.device)


def adapted_kl_coeff(kl_coeff: Tensor, kl: Tensor, target: float) -> Tensor:
    """Return the KL coefficients (P,) for the next update, given the mean KL (P,) of this one.

    Times 1.5 above 2 `target`, times 0.5 below `target` / 2: section 4 of Schulman et al. 2017, with RLlib's
    factors.
    """
    kl_coeff = torch.where(kl > 2 * target, kl_coeff * 1.5, kl_coeff)
    return torch.where(kl < target / 2, kl_coeff * 0.5, kl_coeff)


def _network_outputs(actor: Actor, rows: PolicyBatch, config: AlgoConfig) -> Tensor:
    """Return the network outputs (P, B, A) of all rows."""
    if rows.sequences is not None:
        return over_rows(actor.network, rows.observations, rows.sequences, config.piece_samples)
    with torch.no_grad():
        pieces = even_slices(rows.observations.shape[1], len(rows.observations), config.piece_samples)
        outputs = torch.cat([actor.network(rows.observations[:, piece]) for piece in pieces], dim=2)
        return outputs.transpose(1, 2).contiguous()


def _mean_kl(
    actor: Actor, rows: PolicyBatch, old: tuple[Tensor | None, Tensor | None], config: AlgoConfig
) -> Tensor:
    """Return the mean KL(old || new) of each policy over its selected rows, (P,)."""
    old_outputs, old_log_std = old
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
            before = actor.distribution(old_outputs[:, part].transpose(1, 2), masks, old_log_std)
            total += torch.where(selected[:, part], new.kl_from(before), 0).sum(1)
    return total / selected.sum(1).clamp(min=1)

"""PPO's adaptive penalty on the KL divergence from the policies that acted.

Source: Schulman et al. 2017, arXiv:1707.06347, section 4, with RLlib's factors.
"""

from copy import copy
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from torch import Tensor

from headway_algos.batches.minibatches import Piece, even_slices
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.sequences import over_rows
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import Distribution


class OldPolicies(NamedTuple):
    """The policies that acted, and how strongly the penalty ties the new ones to them."""

    outputs: Tensor
    """(P, B, A) network outputs."""
    log_std: Tensor | None
    """(P, A, 1) of Gaussian policies."""
    coefficients: Tensor
    """(P,)"""

    def penalty(self, new: Distribution, actor: Actor, piece: Piece, masks: Tensor | None) -> Tensor:
        """Return coefficient x KL(pi_old || pi) of a piece's rows, (P, rows)."""
        old = actor.distribution(piece.of(self.outputs).transpose(1, 2), masks, self.log_std)
        return self.coefficients[:, None] * new.kl_from(old)


@dataclass
class KLPenalty:
    """Adds coefficient x KL(pi_old || pi) to a policy loss, and adapts the coefficient after each update."""

    coefficients: Tensor
    """(P,)"""
    target: float
    """Mean KL divergence per update that the adaptation aims at."""
    piece_samples: int

    def old_policies(self, actor: Actor, rows: PolicyBatch) -> OldPolicies:
        """Return the current policies, before their update."""
        log_std = None if actor.log_std is None else actor.log_std.detach().clone()
        return OldPolicies(self._outputs(actor, rows), log_std, self.coefficients)

    def adapt(self, actor: Actor, rows: PolicyBatch, old: OldPolicies) -> dict[str, Tensor]:
        """Adapt the coefficients of policies with rows.

        Returns the mean KL divergence after the update, NaN without rows, and the coefficients used in it,
        (P,) each.
        """
        kl = self._mean_kl(actor, rows, old)
        self.coefficients = adapted_coefficients(old.coefficients, kl, self.target)
        return {"kl": kl, "kl_coeff": old.coefficients}

    def narrow(self, policies: Tensor) -> Self:
        """Return the penalty of `policies` (n,)."""
        part = copy(self)
        part.coefficients = self.coefficients[policies]
        return part

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy the coefficients of `policies` (n,) from `part`."""
        self.coefficients = self.coefficients.index_copy(0, policies, part.coefficients)

    def _outputs(self, actor: Actor, rows: PolicyBatch) -> Tensor:
        """Return the network outputs (P, B, A) of all rows."""
        if rows.sequences is not None:
            return over_rows(actor.network, rows.observations, rows.sequences, self.piece_samples)
        with torch.no_grad():
            parts = even_slices(rows.observations.shape[1], len(rows.observations), self.piece_samples)
            outputs = torch.cat([actor.network(rows.observations[:, part]) for part in parts], dim=2)
            return outputs.transpose(1, 2).contiguous()

    def _mean_kl(self, actor: Actor, rows: PolicyBatch, old: OldPolicies) -> Tensor:
        """Return the mean KL(old || new) of each policy over its selected rows, (P,); NaN without rows."""
        selected = torch.from_numpy(rows.selected).to(old.outputs.device)
        total = torch.zeros_like(self.coefficients)
        new_outputs = self._outputs(actor, rows).transpose(1, 2)
        with torch.no_grad():
            for part in even_slices(selected.shape[1], len(selected), self.piece_samples):
                masks = rows.masks[:, part] if rows.masks is not None else None
                new = actor.distribution(new_outputs[:, :, part], masks)
                before = actor.distribution(old.outputs[:, part].transpose(1, 2), masks, old.log_std)
                total += torch.where(selected[:, part], new.kl_from(before), 0).sum(1)
        return total / selected.sum(1)  # 0 / 0 is NaN


def adapted_coefficients(coefficients: Tensor, kl: Tensor, target: float) -> Tensor:
    """Return the coefficients (P,) for the next update, given the mean KL divergence (P,) of this one.

    They are multiplied by 1.5 where the divergence is above 2 `target` and by 0.5 where it is below
    `target` / 2; they are unchanged where it is NaN.
    """
    coefficients = torch.where(kl > 2 * target, coefficients * 1.5, coefficients)
    return torch.where(kl < target / 2, coefficients * 0.5, coefficients)

"""PPO's adaptive penalty on the KL divergence from the policies that acted.

Source: Schulman et al. 2017, arXiv:1707.06347, section 4, with RLlib's factors.
"""

from copy import copy
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from headway_algos.batches.minibatches import even_slices
from headway_algos.batches.old_policies import OldPolicies, outputs_of
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.networks.actor import Actor


@dataclass
class KLPenalty:
    """Adds coefficient x KL(pi_old || pi) to a policy loss, and adapts the coefficient after each update."""

    coefficients: Tensor
    """(P,): current coefficient of each policy."""
    target: float
    """Mean KL divergence per update that the adaptation aims at."""
    piece_samples: int

    def old_policies(self, actor: Actor, rows: PolicyBatch) -> OldPolicies:
        """Return the current policies, before their update."""
        parts = rows.observations, rows.sequences, self.coefficients, self.piece_samples
        return OldPolicies.of(actor, *parts)

    def adapt(self, actor: Actor, rows: PolicyBatch, old: OldPolicies) -> dict[str, Tensor]:
        """Adapt the coefficients of policies with rows.

        Returns the mean KL divergence after the update, NaN without rows, and the coefficients used in it,
        (P,) each.
        """
        kl = mean_kl(actor, rows, old, self.piece_samples)
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


def mean_kl(actor: Actor, rows: PolicyBatch, old: OldPolicies, piece_samples: int) -> Tensor:
    """Return the mean KL(old || new) of each policy over its selected rows, (P,); NaN without rows."""
    selected = torch.from_numpy(rows.selected).to(old.outputs.device)
    total = torch.zeros_like(old.coefficients)
    new_outputs = outputs_of(actor, rows.observations, rows.sequences, piece_samples).transpose(1, 2)
    with torch.no_grad():
        for part in even_slices(selected.shape[1], len(selected), piece_samples):
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

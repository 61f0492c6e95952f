"""Earlier policies that a KL penalty keeps the trained policies near."""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from headway_algos.batches.minibatches import Piece, even_slices
from headway_algos.batches.sequences import Sequences, over_rows
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import Distribution


class OldPolicies(NamedTuple):
    """Earlier policies at the states of a batch, with the coefficients of the penalty that keeps new ones
    near them.

    They are the policies that acted, or those with which training started.
    """

    outputs: Tensor
    """(P, B, A) network outputs."""
    log_std: Tensor | None
    """(P, A, 1) of Gaussian policies."""
    coefficients: Tensor
    """(P,): coefficients of the penalty."""

    @classmethod
    def of(
        cls,
        actor: Actor,
        observations: Tensor,
        sequences: Sequences | None,
        coefficients: Tensor,
        piece_samples: int,
    ) -> Self:
        """Return the policies of `actor` at normalised observations (P, B, D)."""
        log_std = None if actor.log_std is None else actor.log_std.detach().clone()
        return cls(outputs_of(actor, observations, sequences, piece_samples), log_std, coefficients)

    def narrow(self, policies: Tensor) -> Self:
        """Return the part that belongs to `policies` (n,)."""
        log_std = None if self.log_std is None else self.log_std[policies]
        return type(self)(self.outputs[policies], log_std, self.coefficients[policies])

    def penalty(self, new: Distribution, actor: Actor, piece: Piece, masks: Tensor | None) -> Tensor:
        """Return coefficient x KL(pi_old || pi) of a piece's rows, (P, rows)."""
        old = actor.distribution(piece.of(self.outputs).transpose(1, 2), masks, self.log_std)
        return self.coefficients[:, None] * new.kl_from(old)


def outputs_of(actor: Actor, observations: Tensor, sequences: Sequences | None, piece_samples: int) -> Tensor:
    """Return the network outputs (P, B, A) at normalised observations (P, B, D), without gradients."""
    if sequences is not None:
        return over_rows(actor.network, observations, sequences, piece_samples)
    with torch.no_grad():
        parts = even_slices(observations.shape[1], len(observations), piece_samples)
        outputs = torch.cat([actor.network(observations[:, part]) for part in parts], dim=2)
        return outputs.transpose(1, 2).contiguous()

"""In what order a team's policies are improved."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.grouping import Grouping
from headway_algos.on_policy.updates import Update

Order = Callable[
    [Update, Grouping, PolicyBatch, Tensor, Sequence[np.random.Generator], Sequence[np.random.Generator]],
    dict[str, Tensor],
]
"""(update, grouping, rows, advantages (P, B), generators for shuffling (P,), generators for the order (R,))
-> info, each (P,); changes the policies."""


def simultaneous(
    update: Update,
    grouping: Grouping,
    rows: PolicyBatch,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """All policies at once, each against the others as they were."""
    return update.improve(rows, advantages, generators)


def sequential(
    update: Update,
    grouping: Grouping,
    rows: PolicyBatch,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """One policy after another, in an order drawn anew for each replica (Kuba et al. 2022, arXiv:2109.11251).

    The policy whose turn is m-th improves on A times the product of pi_new / pi_old of all agents of the
    policies before it, at the same step and copy, each at what it has become (section 4 there). The ratio is
    1 where such an agent was not acting. The factor is positive, so an update needs to know nothing of it.

    In the paper every agent has a policy of its own (K = N). The agents of a group, who share one, have
    their turn together, as all have without an order. Turns are taken one after another, the replicas'
    together.
    """
    policies, width = grouping.num_policies, grouping.width
    turns = np.stack([random.permutation(policies) for random in order_generators], axis=1)
    replicas, samples = len(order_generators), advantages.shape[1] // width
    log_factor = torch.zeros(replicas, samples, dtype=torch.float64, device=advantages.device)
    info: dict[str, Tensor] = {}
    for turn in turns:
        chosen = np.arange(replicas) * policies + turn
        policies_now = torch.from_numpy(chosen).to(advantages.device)
        part, own_rows = update.narrow(policies_now), rows.narrow(policies_now)
        weighted = advantages[policies_now] * log_factor.exp().to(advantages.dtype).repeat(1, width)
        for name, value in part.improve(own_rows, weighted, [generators[p] for p in chosen]).items():
            info.setdefault(name, value.new_zeros(len(advantages))).index_copy_(0, policies_now, value)
        update.adopt(policies_now, part)
        log_factor += _log_ratio(part, own_rows).view(replicas, width, samples).sum(1)
    return info


def _log_ratio(update: Update, rows: PolicyBatch) -> Tensor:
    """log(pi / pi_old) of what was done, (P, B), 0 where a row is not selected."""
    batch = WholeBatch.of(rows, torch.zeros_like(rows.log_probs))
    result = torch.zeros_like(rows.log_probs, dtype=torch.float64)
    with torch.no_grad():
        for piece in batch.pieces(update.config.piece_samples):
            new = update.actor(piece.observations, piece.masks, piece.timeline)
            log_ratio = new.log_prob(piece.actions) - piece.log_probs
            result.scatter_add_(1, piece.row_index, torch.where(piece.weight > 0, log_ratio, 0).double())
    return result


ORDERS: dict[str, Order] = {"simultaneous": simultaneous, "sequential": sequential}

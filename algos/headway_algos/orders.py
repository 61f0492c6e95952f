"""In what order a team's policies are improved."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from headway_algos.policy_rows import PolicyRows
from headway_algos.updates import Update
from headway_algos.whole_batch import WholeBatch

Order = Callable[
    [Update, PolicyRows, Tensor, Sequence[np.random.Generator], Sequence[np.random.Generator]],
    dict[str, Tensor],
]
"""(update, rows, advantages (P, B), generators for shuffling (P,), generators for the order (R,)) -> info,
each (P,); changes the policies."""


def simultaneous(
    update: Update,
    rows: PolicyRows,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """All policies at once, each against the others as they were."""
    return update.improve(rows, advantages, generators)


def sequential(
    update: Update,
    rows: PolicyRows,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """One agent after another, in an order drawn anew for each replica (Kuba et al. 2022, arXiv:2109.11251).

    The agent whose turn is m-th improves on A times the product of pi_new / pi_old of the agents before it,
    at the same step and copy, each at the policy it has become (section 4 there). The ratio is 1
    where such an agent was not acting. The factor is positive, so an update needs to know nothing of it.

    Every agent has a policy of its own (K = N). Turns are taken one after another, the replicas' together.
    """
    replicas = len(order_generators)
    agents = len(advantages) // replicas
    turns = np.stack([random.permutation(agents) for random in order_generators], axis=1)
    log_factor = torch.zeros(replicas, advantages.shape[1], dtype=torch.float64, device=advantages.device)
    info: dict[str, Tensor] = {}
    for turn in turns:
        chosen = np.arange(replicas) * agents + turn
        policies = torch.from_numpy(chosen).to(advantages.device)
        part, own_rows = update.narrow(policies), rows.narrow(policies)
        weighed = advantages[policies] * log_factor.exp().to(advantages.dtype)
        for name, value in part.improve(own_rows, weighed, [generators[p] for p in chosen]).items():
            info.setdefault(name, value.new_zeros(len(advantages))).index_copy_(0, policies, value)
        update.adopt(policies, part)
        log_factor += _log_ratio(part, own_rows)
    return info


def _log_ratio(update: Update, rows: PolicyRows) -> Tensor:
    """log(pi / pi_old) of what was done, (P, B), 0 where a row is not selected."""
    batch = WholeBatch.of(rows, torch.zeros_like(rows.log_probs))
    result = torch.zeros_like(rows.log_probs, dtype=torch.float64)
    with torch.no_grad():
        for piece in batch.pieces(update.config.piece_samples):
            new = update.actor(piece.observations, piece.masks, piece.timeline)
            log_ratio = new.log_prob(piece.actions) - piece.log_probs
            result.scatter_add_(1, piece.places, torch.where(piece.weight > 0, log_ratio, 0).double())
    return result


ORDERS: dict[str, Order] = {"simultaneous": simultaneous, "sequential": sequential}

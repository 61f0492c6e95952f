"""The sequential order: HAPPO's and HATRPO's."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.grouping import Grouping
from headway_algos.on_policy.updates import Update


def sequential(
    update: Update,
    grouping: Grouping,
    rows: PolicyBatch,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """Update one policy after another, in a random order per replica.

    Source: Kuba et al. 2022, arXiv:2109.11251, section 4. The m-th policy is updated with advantages A times
    the product of pi_new / pi_old over all agents of the policies updated before, at the same step and copy;
    the ratio is 1 where such an agent was not acting. The factor is positive, so it only rescales the
    advantages passed to an unchanged update.

    In the paper every agent has its own policy (K = N). Agents of a group that shares a policy are updated
    together. The m-th policies of all replicas are updated in one call.
    """
    policies, width = grouping.num_policies, grouping.width
    turns = np.stack([random.permutation(policies) for random in order_generators], axis=1)
    replicas, samples = len(order_generators), advantages.shape[1] // width
    # Logarithms in float64: the product of many agents' ratios could underflow or overflow in float32.
    log_factor = torch.zeros(replicas, samples, dtype=torch.float64, device=advantages.device)
    info: dict[str, Tensor] = {}
    for turn in turns:
        chosen = np.arange(replicas) * policies + turn
        policies_now = torch.from_numpy(chosen).to(advantages.device)
        part, own_rows = update.narrow(policies_now), rows.narrow(policies_now)
        # The factor belongs to a step and copy: it is the same for every agent of the policy.
        weighted = advantages[policies_now] * log_factor.exp().to(advantages.dtype).repeat(1, width)
        for name, value in part.improve(own_rows, weighted, [generators[p] for p in chosen]).items():
            info.setdefault(name, value.new_zeros(len(advantages))).index_copy_(0, policies_now, value)
        update.adopt(policies_now, part)
        log_factor += _log_ratio(part, own_rows).view(replicas, width, samples).sum(1)
    return info


def _log_ratio(update: Update, rows: PolicyBatch) -> Tensor:
    """Return log(pi / pi_old) of the actions taken, (P, B), 0 for rows not selected."""
    batch = WholeBatch.of(rows, torch.zeros_like(rows.log_probs))
    result = torch.zeros_like(rows.log_probs, dtype=torch.float64)
    with torch.no_grad():
        for piece in batch.pieces(update.config.piece_samples):
            new = update.actor(piece.observations, piece.masks, piece.timeline)
            log_ratio = new.log_prob(piece.actions) - piece.log_probs
            result.scatter_add_(1, piece.row_index, torch.where(piece.weight > 0, log_ratio, 0).double())
    return result

"""Minibatch steps of policies by compiled kernels: PPO's and A2C's losses, perceptrons in float32 on a CPU.

`tests/algos/optim/test_fast_path.py` checks the kernels against autograd.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from torch import Tensor

from headway_algos.batches.old_policies import OldPolicies
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.schedule import MinibatchSchedule
from headway_algos.kernels.minibatch_steps import (
    BoxActions,
    DiscreteActions,
    PolicyData,
    descend_categorical,
    descend_gaussian,
)
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import MaskedCategorical
from headway_algos.on_policy.updates.losses import A2CLoss, PolicyLoss, PPOLoss
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.fast_path import as_array, compiled_steps, kernel_networks
from headway_algos.optim.gradient_steps import Steps


def compiled_policy_steps(
    loss: PolicyLoss,
    actor: Actor,
    optimiser: StackedAdam,
    rows: PolicyBatch,
    advantages: Tensor,
    tied: Sequence[OldPolicies],
) -> Steps | None:
    """Return the steps that minimise a loss by compiled kernels, or None to take them by autograd.

    `tied`: earlier policies that KL penalties keep the new ones near.
    """
    networks = kernel_networks(actor.network, optimiser)
    # The kernels have one categorical per row, not several, and one penalty.
    if networks is None or actor.nvec or len(tied) > 1:
        return None
    old = tied[0] if tied else None
    # Exact types only: a subclass may compute another loss, for which there is no kernel.
    if type(loss) is PPOLoss:
        clipped, clip, entropy_coeff = True, float(loss.clip), float(loss.entropy_coeff)
    elif type(loss) is A2CLoss:
        clipped, clip, entropy_coeff = False, 0.0, float(loss.entropy_coeff)
    else:
        return None
    numbers, outputs = np.empty(0, np.float32), networks.outputs
    table = numbers.reshape(0, outputs)
    old_outputs, coefficients = None, numbers
    if old is not None:
        old_outputs, coefficients = old.outputs, old.coefficients.numpy()
        before = actor.distribution(old_outputs.transpose(1, 2), rows.masks)
        if isinstance(before, MaskedCategorical):
            old_outputs = before.log_probs.exp().transpose(1, 2)
    data = PolicyData(
        as_array(rows.observations, table), as_array(rows.log_probs, numbers), as_array(advantages, numbers),
        as_array(old_outputs, table), coefficients, clipped, clip, entropy_coeff,
    )  # fmt: skip
    if actor.log_std is None:
        masks = as_array(rows.masks, np.empty((0, outputs), np.bool_))
        discrete = DiscreteActions(as_array(rows.actions, np.empty(0, np.int64)), masks)
        take_steps = compiled_steps(descend_categorical, networks, optimiser, (data, discrete), 3)
    else:
        (start,) = optimiser.starts([actor.log_std])
        old_log_std = actor.log_std.detach() if old is None or old.log_std is None else old.log_std
        log_std = np.ascontiguousarray(old_log_std[..., 0].numpy())
        box = BoxActions(as_array(rows.actions, table), log_std, start)
        take_steps = compiled_steps(descend_gaussian, networks, optimiser, (data, box), 3)
    return take_steps if type(loss) is PPOLoss else partial(_entropy_alone, take_steps)


def _entropy_alone(take_steps: Steps, schedule: MinibatchSchedule) -> tuple[Tensor, Tensor]:
    """Take the steps; leave out the metrics that A2C does not have."""
    (_, entropy, _), norms = take_steps(schedule)
    return entropy[None], norms

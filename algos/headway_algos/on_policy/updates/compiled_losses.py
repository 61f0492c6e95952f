"""Training of policies with compiled kernels: the losses of PPO and A2C, perceptrons in float32 on a CPU.

`tests/algos/optim/test_fast_path.py` holds the kernels to autograd.
"""

from functools import partial

import numpy as np
from torch import Tensor

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.networks.actor import Actor
from headway_algos.networks.distributions import MaskedCategorical
from headway_algos.on_policy.updates.kl_penalty import KLPenalty, OldPolicies
from headway_algos.on_policy.updates.losses import A2CLoss, PolicyLoss, PPOLoss
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.fast_path import Descent, RowIndices, as_array, descent, perceptrons_of


def compiled_loss(
    loss: PolicyLoss,
    actor: Actor,
    optimiser: StackedAdam,
    rows: PolicyBatch,
    advantages: Tensor,
    penalty: KLPenalty | None,
    old: OldPolicies | None,
) -> Descent | None:
    """Return the function that trains on a loss by compiled kernels, or None to train by autograd.

    `old` are the policies that acted; None without a penalty.
    """
    networks = perceptrons_of(actor.network, optimiser)
    if networks is None or actor.nvec:
        return None
    # A subclass is another loss.
    if type(loss) is PPOLoss:
        clip, entropy_coeff = float(loss.clip), float(loss.entropy_coeff)
    elif type(loss) is A2CLoss:
        clip, entropy_coeff = -1.0, float(loss.entropy_coeff)
    else:
        return None
    from headway_algos import kernels

    numbers, outputs = np.empty(0, np.float32), networks.outputs
    table = numbers.reshape(0, outputs)
    old_outputs, coefficients = None, numbers
    if penalty is not None and old is not None:
        old_outputs, coefficients = old.outputs, penalty.coefficients.numpy()
        before = actor.distribution(old_outputs.transpose(1, 2), rows.masks)
        if isinstance(before, MaskedCategorical):
            old_outputs = before.log_probs.exp().transpose(1, 2)
    data = kernels.PolicyData(
        as_array(rows.observations, table), as_array(rows.log_probs, numbers), as_array(advantages, numbers),
        as_array(old_outputs, table), coefficients, clip, entropy_coeff,
    )  # fmt: skip
    if actor.log_std is None:
        masks = as_array(rows.masks, np.empty((0, outputs), np.bool_))
        discrete = kernels.DiscreteActions(as_array(rows.actions, np.empty(0, np.int64)), masks)
        descend = descent(kernels.descend_categorical, networks, optimiser, (data, discrete), 3)
    else:
        (start,) = optimiser.starts([actor.log_std])
        old_log_std = actor.log_std.detach() if old is None or old.log_std is None else old.log_std
        log_std = np.ascontiguousarray(old_log_std[..., 0].numpy())
        box = kernels.BoxActions(as_array(rows.actions, table), log_std, start)
        descend = descent(kernels.descend_gaussian, networks, optimiser, (data, box), 3)
    return descend if type(loss) is PPOLoss else partial(_entropy_alone, descend)


def _entropy_alone(descend: Descent, epochs: RowIndices) -> tuple[Tensor, Tensor]:
    """Take the steps; leave out the reported numbers that A2C does not have."""
    (_, entropy, _), norms = descend(epochs)
    return entropy[None], norms

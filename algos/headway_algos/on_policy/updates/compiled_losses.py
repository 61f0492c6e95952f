"""Selection of the compiled kernel for a loss: multilayer perceptrons in float32 on a CPU."""

from torch import Tensor

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.a2c import A2C
from headway_algos.on_policy.updates.policy_loss import PolicyLoss
from headway_algos.on_policy.updates.ppo import PPO
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.fast_path import policy_gradients
from headway_algos.optim.gradient_steps import Learn


def compiled_loss(
    loss: PolicyLoss,
    actor: Actor,
    optimiser: StackedAdam,
    rows: PolicyBatch,
    advantages: Tensor,
    old: tuple[Tensor | None, Tensor | None],
    kl_coeff: Tensor,
) -> Learn | None:
    """Return the compiled gradients of a loss, or None if only autograd has them.

    `old` are the network outputs (P, B, A) and log standard deviations (P, A, 1) of the policies that acted;
    the outputs are None without a KL penalty.
    """
    if type(loss) is PPO:  # a subclass is another loss
        return policy_gradients(
            actor, optimiser, rows, advantages, old, kl_coeff, loss.entropy_coeff, loss.clip
        )
    if type(loss) is A2C:
        learn = policy_gradients(actor, optimiser, rows, advantages, old, kl_coeff, loss.entropy_coeff, None)
        return None if learn is None else lambda piece: learn(piece)[1:2]
    return None

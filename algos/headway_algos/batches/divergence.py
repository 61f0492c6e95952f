"""Errors for training that has diverged, with what to change."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_algos.batches.policy_stack import PolicyStack
from headway_algos.config import LearnerConfig


def raise_if_diverged(stack: PolicyStack, acting: Mapping[str, NDArray[Any]], when: str) -> None:
    """Raise HeadwayError, naming policy and seed, if acting parameters (P, ., .) are not all finite.

    `when`: for instance "iteration 7".
    """
    for array in acting.values():
        broken = ~np.isfinite(array).all(axis=(1, 2))
        if broken.any():
            replica, policy = divmod(int(broken.argmax()), stack.grouping.num_policies)
            owner = stack.grouping.owner(policy, stack.spec)
            raise HeadwayError(
                f"{stack.config.name} diverged: the policy of {owner}, seed {stack.seeds[replica]}, is not "
                f"finite after {when}; {remedy(stack.config)}"
            )


def raise_if_critic_diverged(stack: PolicyStack, advantages: NDArray[np.float64], when: str) -> None:
    """Raise HeadwayError, naming the seed, if advantages (T, C, W) are not finite.

    TRPO would reject every step on such advantages, and training would continue without effect.
    """
    broken = np.argwhere(~np.isfinite(advantages))
    if len(broken):
        seed = stack.seeds[broken[:, 1].min() * len(stack.seeds) // advantages.shape[1]]
        raise HeadwayError(
            f"{stack.config.name} diverged: the critic of seed {seed} gives values that are not finite at "
            f"{when}; {remedy(stack.config, of_critic=True)}"
        )


def remedy(config: LearnerConfig, of_critic: bool = False) -> str:
    """Return what to change when the policies or the critic diverge, in keys that the algorithm has."""
    values = {key.name: getattr(config, key.name) for key in fields(config)}
    names = ["lr", "kl_bound"]
    if of_critic:
        names = ["lr" if values.get("critic_lr") is None else "critic_lr", "critic_kl_bound"]
    clipped = values.get("grad_clip") is not None
    lower = " or ".join(f"algo.{name}" for name in [*names, *["grad_clip"] * clipped] if name in values)
    unbounded = "grad_clip" in values and not clipped
    return f"lower {lower}" + (", or bound the gradients by algo.grad_clip" if unbounded else "")

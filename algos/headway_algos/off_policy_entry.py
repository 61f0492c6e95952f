"""Registry entries of the off-policy algorithms. Importing them imports neither torch nor numba."""

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from headway.contracts import AlgoEntry, Box, Discrete, EnvSpec, HeadwayError, Lazy
from headway_algos.agent_id import agent_ids, impossible_ids
from headway_algos.grouping import Grouping
from headway_algos.recipes import KERNELS, ReplayRecipe
from headway_algos.replay_config import DDPGConfig, ReplayConfig

if TYPE_CHECKING:
    from headway_algos.acting.exploration import EpsilonGreedyPolicy, OrnsteinUhlenbeckPolicy

LEARNER = Lazy("headway_algos.off_policy.learner:OffPolicyLearner")


def _kind(spec: EnvSpec) -> str:
    return type(spec.action_space).__name__


def _refuses_all_but_discrete(config: ReplayConfig, spec: EnvSpec) -> str | None:
    if not isinstance(spec.action_space, Discrete):
        instead = "ddpg" if isinstance(spec.action_space, Box) else "ippo"
        return (
            f"{config.name} takes Discrete actions, whose values it compares, and {spec.name} has "
            f"{_kind(spec)} ones; use algo={instead}"
        )
    return impossible_ids(config, spec)


def _refuses_all_but_bounded(config: ReplayConfig, spec: EnvSpec) -> str | None:
    space = spec.action_space
    if not isinstance(space, Box):
        instead = "madqn" if isinstance(space, Discrete) else "ippo"
        return (
            f"{config.name} takes Box actions, for which its critic has gradients, and {spec.name} has "
            f"{_kind(spec)} ones; use algo={instead}"
        )
    if not space.bounded:
        return (
            f"{config.name} takes bounded Box actions, which it scales to the bounds, and {spec.name} has "
            "unbounded ones; use an algorithm with Gaussian actions, such as algo=ippo"
        )
    return impossible_ids(config, spec)


def _epsilon_greedy(config: ReplayConfig, spec: EnvSpec) -> "EpsilonGreedyPolicy":
    from headway_algos.acting.exploration import EpsilonGreedyPolicy
    from headway_algos.acting.mlp import MLPActingPolicy

    if (line := _refuses_all_but_discrete(config, spec)) is not None:
        raise HeadwayError(line)
    return EpsilonGreedyPolicy(MLPActingPolicy.of(config, spec))


def _ornstein_uhlenbeck(config: DDPGConfig, spec: EnvSpec) -> "OrnsteinUhlenbeckPolicy":
    from headway_algos.acting.exploration import OrnsteinUhlenbeckPolicy
    from headway_algos.acting.mlp import MLPActingPolicy

    if (line := _refuses_all_but_bounded(config, spec)) is not None:
        raise HeadwayError(line)
    return OrnsteinUhlenbeckPolicy(MLPActingPolicy.of(config, spec), config.ou_theta, config.ou_sigma)


def _replay_bytes(config: ReplayConfig, spec: EnvSpec, env_steps: int) -> int:
    """Return the bytes of one seed's replay buffers, full or after `env_steps`, whichever is less.

    A transition is two observations, an action, a mask, a return and a discount.
    """
    members = Grouping.of(config.policies, spec).is_member.sum(axis=1)
    transitions = int(np.minimum(config.capacity, members * env_steps).sum())
    space = spec.action_space
    mask = sum(space.options) if spec.has_action_mask else 0
    action = 4 * space.size if isinstance(space, Box) else 8
    size = spec.observation_size + int(agent_ids(config, spec).shape[1])
    return transitions * (2 * 4 * size + action + mask + 2 * 8)


def _rollout(config: ReplayConfig) -> dict[str, int]:
    # Learning follows each iteration, so iterations must be short.
    return {"steps": 32}


def replay_entry(recipe: ReplayRecipe) -> AlgoEntry:
    """Return the registry entry of an off-policy algorithm."""
    discrete = recipe.actions is Discrete
    return AlgoEntry(
        recipe.summary,
        recipe.source,
        recipe.config,
        acting_policy=_epsilon_greedy if discrete else _ornstein_uhlenbeck,
        learner=partial(LEARNER, method=recipe.make_method),
        refuses=_refuses_all_but_discrete if discrete else _refuses_all_but_bounded,
        replay_bytes=_replay_bytes,
        starts=True,
        kernels=KERNELS,
        rollout=_rollout,
    )

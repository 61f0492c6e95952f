"""Registry entries of the off-policy algorithms. Importing them imports no torch."""

from functools import partial

import numpy as np

from headway.contracts import AlgoEntry, Box, Discrete, EnvSpec, HeadwayError, Lazy
from headway_algos.acting.exploration import EpsilonGreedyPolicy, OrnsteinUhlenbeckPolicy
from headway_algos.grouping import Grouping, missing_groups
from headway_algos.recipes import ddpg, madqn
from headway_algos.replay_config import ReplayConfig

LEARNER = Lazy("headway_algos.off_policy.learner:OffPolicyLearner")


def _kind(spec: EnvSpec) -> str:
    return type(spec.action_space).__name__


def _madqn_refuses(config: madqn.MADQNConfig, spec: EnvSpec) -> str | None:
    if not isinstance(spec.action_space, Discrete):
        instead = "; use algo=ddpg" if isinstance(spec.action_space, Box) else ""
        return (
            f"{config.name} takes Discrete actions, whose values it compares, and {spec.name} has "
            f"{_kind(spec)} ones{instead}"
        )
    return missing_groups(config.policies, spec)


def _ddpg_refuses(config: ddpg.DDPGConfig, spec: EnvSpec) -> str | None:
    space = spec.action_space
    if not isinstance(space, Box):
        instead = "; use algo=madqn" if isinstance(space, Discrete) else ""
        return (
            f"{config.name} takes Box actions, for which its critic has gradients, and {spec.name} has "
            f"{_kind(spec)} ones{instead}"
        )
    if not np.isfinite((space.low, space.high)).all():
        return (
            f"{config.name} takes bounded Box actions, which it scales to the bounds, and {spec.name} has "
            "unbounded ones; use an algorithm with Gaussian actions, such as algo=ippo"
        )
    return missing_groups(config.policies, spec)


def _epsilon_greedy(config: madqn.MADQNConfig, spec: EnvSpec) -> EpsilonGreedyPolicy:
    if (line := _madqn_refuses(config, spec)) is not None:
        raise HeadwayError(line)
    return EpsilonGreedyPolicy.of(config, spec)


def _ornstein_uhlenbeck(config: ddpg.DDPGConfig, spec: EnvSpec) -> OrnsteinUhlenbeckPolicy:
    if (line := _ddpg_refuses(config, spec)) is not None:
        raise HeadwayError(line)
    return OrnsteinUhlenbeckPolicy.of(config, spec, config.ou_theta, config.ou_sigma)


def _replay_bytes(config: ReplayConfig, spec: EnvSpec, env_steps: int) -> int:
    """Return the bytes of one seed's replay buffers, full or after `env_steps`, whichever is less.

    A transition is two observations, an action, a mask, a return and a discount.
    """
    members = Grouping.of(config.policies, spec).is_member.sum(axis=1)
    transitions = int(np.minimum(config.capacity, members * env_steps).sum())
    space = spec.action_space
    mask = space.n if spec.has_action_mask and isinstance(space, Discrete) else 0
    action = 4 * space.size if isinstance(space, Box) else 8
    return transitions * (2 * 4 * spec.observation_size + action + mask + 2 * 8)


OFF_POLICY = {
    "ddpg": AlgoEntry(
        ddpg.SUMMARY,
        ddpg.SOURCE,
        ddpg.DDPGConfig,
        _ornstein_uhlenbeck,
        partial(LEARNER, method=Lazy("headway_algos.off_policy.ddpg:DeterministicPolicyGradient")),
        _ddpg_refuses,
        _replay_bytes,
    ),
    "madqn": AlgoEntry(
        madqn.SUMMARY,
        madqn.SOURCE,
        madqn.MADQNConfig,
        _epsilon_greedy,
        partial(LEARNER, method=Lazy("headway_algos.off_policy.dqn:QLearning")),
        _madqn_refuses,
        _replay_bytes,
    ),
}

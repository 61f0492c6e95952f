"""Comparison of batched wrappers on a native environment with SuperSuit's on its ParallelEnv."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.adapters.conformance import play
from headway.adapters.pettingzoo import AdapterOptions, ParallelEnvBatch, episode_seed
from headway.adapters.recording import Recording
from headway.contracts import BatchedEnv, EnvEntry
from headway.wrappers.listed import listed_wrappers
from headway.wrappers.parallel import WrappedParallelEnv
from headway.wrappers.wrapped_env import Wrapped, wrapped_entry

SEED = 5
"""Seed of the first copy in `play`."""


def prepared(name: str, entry: EnvEntry, wrappers: Sequence[Any], **arguments: object) -> Wrapped:
    """Return the prepared data of a wrapped environment."""
    made = wrapped_entry(name, entry, listed_wrappers(wrappers)).prepare(entry.config(**arguments))
    assert isinstance(made, Wrapped)
    return made


def through_supersuit(wrapped: Wrapped, entry: EnvEntry, wrappers: Sequence[Any]) -> Recording:
    """Record random play of one copy, with every wrapper applied to the ParallelEnv."""
    assert entry.parallel_env is not None
    listed = tuple(
        (wrapper.name, {key: value for key, value in wrapper.mapping.items() if key != "name"})
        for wrapper in listed_wrappers(wrappers)
    )
    spec = wrapped.batch(1).spec
    options = AdapterOptions(
        shared_reward=spec.shared_reward, groups=spec.groups, agents_come_and_go=spec.agents_come_and_go,
        max_copies_per_process=spec.max_copies_per_process, metrics=spec.metrics,
    )  # fmt: skip
    make = WrappedParallelEnv(entry.parallel_env, wrapped.prepared, listed)
    return play(
        lambda copies: ParallelEnvBatch(make, copies, wrapped.name, options), copies=1, first_seed=SEED
    )


def assert_same_game(env: BatchedEnv, through: Recording) -> None:
    """Assert that `env`, of one copy, reproduces the recording bit for bit with the same seeds and actions.

    Episode i of an adapted environment is episode 0 of the seed that the adapter derives for i.
    """
    track, spec, start, episodes = through.trajectory, env.spec, 0, 0
    left_out = {"snapshots": 0, "observation_features": ()}  # a ParallelEnv has neither
    assert {**vars_of(spec), **left_out} == {**vars_of(through.spec), **left_out}
    while start < through.steps and through.episode_ended[start:].any():
        observed = env.reset(np.array([episode_seed(SEED, episodes)], dtype=np.uint64))
        gone = np.zeros((1, spec.num_agents), dtype=np.bool_)
        for step in range(start, through.steps):
            live = observed.alive
            same(live, track.alive[step])
            same(observed.observations[live], track.observations[step][live])
            same(observed.states, track.states[step])
            if observed.action_masks is not None:
                same(observed.action_masks[live], track.action_masks[step][live])
            outcome, observed = env.step(track.actions[step])
            for field in ("rewards", "terminated", "truncated", "acting"):
                same(getattr(outcome, field), getattr(track, field)[step])
            # An agent that ended earlier is marked again, without a new final observation.
            over = (outcome.terminated | outcome.truncated) & ~gone
            same(outcome.final_observations[over], track.final_observations[step][over])
            gone |= over
            if outcome.episode_ended[0]:
                same(outcome.final_states, track.final_states[step])
                same(outcome.metrics, through.metrics[step])
                start, episodes = step + 1, episodes + 1
                break
    assert episodes > 0, "no episode ended within the recording"


def vars_of(spec: object) -> Mapping[str, Any]:
    return {name: getattr(spec, name) for name in spec.__dataclass_fields__}  # type: ignore[attr-defined]


def same(one: NDArray[Any], other: NDArray[Any]) -> None:
    np.testing.assert_array_equal(one, other)

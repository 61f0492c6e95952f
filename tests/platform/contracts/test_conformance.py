"""Every registered environment keeps the contract, natively and through its ParallelEnv."""

import warnings
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from headway.adapters.conformance import CHECKS, Make, play
from headway.adapters.gymnasium import GymnasiumBatch
from headway.adapters.pettingzoo import ParallelEnvBatch, episode_seed
from headway.adapters.recording import Recording
from headway_envs.registry import ENTRIES

pytestmark = pytest.mark.slow

WITH_PARALLEL_ENV = [name for name, entry in ENTRIES.items() if entry.parallel_env is not None]
SHORT: Mapping[str, Mapping[str, Any]] = {
    "intersection": {"horizon": 400},
    "bus_published": {"scenario": "line"},
}
"""Arguments that shorten environments with long episodes or slow preparation."""


def config_of(name: str) -> Any:  # noqa: ANN401 - the entry's record
    if name == "intersection":
        pytest.importorskip("libsumo", reason="SUMO (headway[sumo]) is not installed")
    return ENTRIES[name].config(**SHORT.get(name, {}))


def native(name: str) -> Make:
    entry = ENTRIES[name]
    return lambda copies: entry.make(entry.prepare(config_of(name)), copies)


def adapted(name: str) -> Make:
    config, parallel_env = config_of(name), ENTRIES[name].parallel_env
    assert parallel_env is not None
    with closing(native(name)(1)) as env:
        shared, limit = env.spec.shared_reward, env.spec.max_copies_per_process
    return lambda copies: ParallelEnvBatch(
        lambda: parallel_env(config), copies, name, shared_reward=shared, max_copies_per_process=limit
    )


def gymnasium_batch(name: str) -> Make:
    return lambda copies: GymnasiumBatch(lambda: gymnasium.make(name), copies, name)


CASES: dict[str, Callable[[], Make]] = {
    **{name: partial(native, name) for name in ENTRIES},
    **{f"{name} adapted": partial(adapted, name) for name in WITH_PARALLEL_ENV},
    **{name: partial(gymnasium_batch, name) for name in ("CartPole-v1", "Pendulum-v1")},
}
RECORDED: dict[str, Recording] = {}


def recorded(case: str) -> Recording:
    if case not in RECORDED:
        RECORDED[case] = play(CASES[case]())
    return RECORDED[case]


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("case", CASES)
def test_keeps_the_contract(case: str, check: str) -> None:
    CHECKS[check](CASES[case](), recorded(case))


@pytest.mark.parametrize("name", WITH_PARALLEL_ENV)
def test_batched_and_parallel_env_give_the_same_episodes(name: str) -> None:
    """Episode i of the adapter equals episode 0 of the batch with the seed derived for i."""
    config = config_of(name)
    through = recorded(f"{name} adapted").of_copy(0)
    track, start = through.trajectory, 0
    env = native(name)(1)
    for episode in range(int(through.episode_ended.sum())):
        observed = env.reset(np.array([episode_seed(5, episode)], dtype=np.uint64))
        gone = np.zeros(env.spec.num_agents, dtype=np.bool_)
        for step in range(start, through.steps):
            np.testing.assert_array_equal(observed.alive, track.alive[step])
            live = observed.alive
            np.testing.assert_array_equal(observed.observations[live], track.observations[step][live])
            np.testing.assert_array_equal(observed.states, track.states[step])
            if observed.action_masks is not None:
                np.testing.assert_array_equal(observed.action_masks[live], track.action_masks[step][live])
            outcome, observed = env.step(track.actions[step])
            for field in ("rewards", "terminated", "truncated", "acting"):
                np.testing.assert_array_equal(getattr(outcome, field), getattr(track, field)[step], field)
            # An agent that ended earlier is marked again without a final observation.
            over = (outcome.terminated | outcome.truncated) & ~gone
            np.testing.assert_array_equal(
                outcome.final_observations[over], track.final_observations[step][over]
            )
            gone |= over[0]
            if outcome.episode_ended[0]:
                np.testing.assert_array_equal(outcome.final_states, track.final_states[step])
                np.testing.assert_array_equal(outcome.metrics, through.metrics[step])
                start = step + 1
                break
    env.close()
    assert start > 0, f"no episode of {config} ended within the recording"


@pytest.mark.parametrize("name", WITH_PARALLEL_ENV)
def test_passes_pettingzoos_own_tests(name: str) -> None:
    config, parallel_env = config_of(name), ENTRIES[name].parallel_env
    assert parallel_env is not None
    with warnings.catch_warnings(), closing(native(name)(1)) as env:
        warnings.simplefilter("error")
        with closing(parallel_env(config)) as face:
            parallel_api_test(face, num_cycles=300)
        if env.spec.max_copies_per_process is None:  # it plays two at once
            parallel_seed_test(lambda: parallel_env(config), num_cycles=50)

"""PettingZoo ParallelEnv of the bus environment."""

import warnings

import numpy as np
from pettingzoo.test import parallel_api_test, parallel_seed_test

from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.parallel import BusParallelEnv
from headway_envs.bus.prepared import Prepared


def test_pettingzoos_api_test_passes(line: Prepared) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(BusParallelEnv(line), num_cycles=1300)
        parallel_seed_test(lambda: BusParallelEnv(line), num_cycles=100)


def test_the_parallel_env_and_the_batch_give_the_same_day(line: Prepared) -> None:
    face, batch = BusParallelEnv(line), BusBatchedEnv(line, 1)
    seen, infos = face.reset(seed=5)
    observed = batch.reset(np.array([5], np.uint64))
    rng, steps = np.random.default_rng(0), 0
    while face.agents:
        for n, name in enumerate(face.agents):
            assert np.array_equal(seen[name], observed.observations[0, n])
            assert infos[name]["alive"] == observed.alive[0, n]
        actions = rng.choice(3, len(face.agents), p=[0.2, 0.79, 0.01]).astype(np.int64)
        names = face.possible_agents
        seen, rewards, terminated, truncated, infos = face.step(dict(zip(names, actions, strict=True)))
        outcome, observed = batch.step(actions[None])
        assert [rewards[name] for name in names] == outcome.rewards[0].tolist()
        assert [infos[name]["acting"] for name in names] == outcome.acting[0].tolist()
        steps += 1
        if not face.agents:
            break
        assert np.array_equal(face.state(), observed.states[0])
    assert face.metadata["episode_metrics"] == batch.spec.metrics
    assert steps == BusConfig().ticks
    assert all(terminated.values())
    assert not any(truncated.values())
    assert np.array_equal(face.state(), outcome.final_states[0])
    for n, name in enumerate(face.possible_agents):
        assert np.array_equal(seen[name], outcome.final_observations[0, n])
        assert list(infos[name]["episode_metrics"].values()) == outcome.metrics[0].tolist()

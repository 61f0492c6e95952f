"""PettingZoo ParallelEnvs with vehicles or with slots as agents."""

import warnings
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from hosted import HostedEnv
from pettingzoo.test import parallel_api_test, parallel_seed_test

from headway.contracts import HeadwayError
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.parallel import IntersectionParallelEnv, IntersectionSlotsParallelEnv


def test_pettingzoos_api_test_passes() -> None:
    """With vehicles as agents its test requires at the end of an episode that every possible agent has lived;
    episodes are therefore longer than the test, except with slots."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with closing(IntersectionParallelEnv(IntersectionConfig())) as vehicles:
            parallel_api_test(vehicles, num_cycles=150)
        with closing(IntersectionParallelEnv(IntersectionConfig(action_repeat=5))) as vehicles:
            parallel_api_test(vehicles, num_cycles=40)
        with closing(IntersectionSlotsParallelEnv(IntersectionConfig(horizon=60))) as slots:
            parallel_api_test(slots, num_cycles=130)


@pytest.mark.parametrize("face", ["vehicles", "slots"])
def test_two_environments_with_one_seed_are_equal(face: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_seed_test(lambda: HostedEnv(face, IntersectionConfig()), num_cycles=3)


def test_vehicles_appear_once_and_equal_those_of_the_batch(crossing: Callable[..., Any]) -> None:
    """In the batched environment every vehicle has the same observations and rewards."""
    config = IntersectionConfig(horizon=700, av_speed_mode=0, hdv_speed_mode=1)
    lives: dict[str, list[tuple[Any, ...]]] = {}
    events: dict[str, str] = {}
    with closing(IntersectionParallelEnv(config)) as face:
        seen, _ = face.reset(seed=4)
        order = []
        while face.agents:
            assert set(seen) >= set(face.agents)
            acting = list(face.agents)
            order += [name for name in acting if name not in order]
            seen, rewards, terminated, truncated, infos = face.step(
                {name: np.array([2.0], np.float32) for name in acting}
            )
            for name in acting:
                assert name not in events, "revived"
                lives.setdefault(name, []).append((seen[name].tobytes(), rewards[name]))
                if terminated[name] or truncated[name]:
                    events[name] = infos[name]["event"]
        assert order == [f"av_{number}" for number in range(len(order))]
        assert set(events.values()) == {"arrived", "collided", "horizon"}
        assert "episode_metrics" in infos[acting[0]]
    env = crossing(horizon=700, av_speed_mode=0, hdv_speed_mode=1)
    observed = env.reset(np.array([4], np.uint64))
    replayed: dict[str, list[tuple[Any, ...]]] = {}
    ended = False
    while not ended:
        serial = env.bridge.roster.serial.copy()
        there = np.flatnonzero(observed.alive[0]).tolist()
        outcome, observed = env.step(np.full((1, 96, 1), 2, np.float32))
        ended = bool(outcome.episode_ended[0])
        over = outcome.terminated[0] | outcome.truncated[0]
        for slot in there:
            now = outcome.final_observations if over[slot] else observed.observations
            replayed.setdefault(f"av_{serial[slot]}", []).append(
                (now[0, slot].tobytes(), float(outcome.rewards[0, slot]))
            )
    assert replayed == lives


def test_a_slot_is_reused_by_later_vehicles() -> None:
    config = IntersectionConfig(horizon=700, vph_per_lane_av=100)
    with closing(IntersectionSlotsParallelEnv(config)) as face:
        _, infos = face.reset(seed=4)
        ended = {}
        taken_again = 0
        while face.agents:
            before = {name: infos[name]["alive"] for name in face.agents}
            seen, _, terminated, truncated, infos = face.step(
                dict.fromkeys(face.agents, np.array([2.0], np.float32))
            )
            if not face.agents:
                break
            assert not any(terminated.values())
            assert not any(truncated.values())
            for name, info in infos.items():
                assert info["acting"] == before[name]
                if "slot_ended" in info:
                    assert before[name]
                    assert not info["alive"]
                    ended[name] = info["slot_ended"]
                elif not info["alive"]:
                    assert not seen[name].any()
                elif not before[name]:
                    taken_again += name in ended
        assert taken_again > 0
        assert all(truncated.values())
        assert set(ended.values()) == {"terminated", "truncated"}  # crashed and arrived


def _play(face: IntersectionParallelEnv, steps: int) -> None:
    for _ in range(steps):
        face.step(dict.fromkeys(face.agents, np.zeros(1, np.float32)))


def test_more_vehicles_than_ids_are_an_error() -> None:
    with closing(IntersectionParallelEnv(IntersectionConfig(), vehicles=2)) as face:
        face.reset(seed=4)
        with pytest.raises(HeadwayError, match="more than 2 automated vehicles entered"):
            _play(face, 300)
    with (
        closing(IntersectionParallelEnv(IntersectionConfig(horizon=3))) as face,
        pytest.raises(HeadwayError, match="no automated vehicle entered in a whole episode"),
    ):
        face.reset(seed=4)

"""PettingZoo ParallelEnv with slots as agents."""

import warnings
from contextlib import closing

import numpy as np
from hosted import HostedEnv
from pettingzoo.test import parallel_seed_test

from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.parallel import IntersectionSlotsParallelEnv


def test_two_environments_with_one_seed_are_equal() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_seed_test(lambda: HostedEnv(IntersectionConfig()), num_cycles=3)


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

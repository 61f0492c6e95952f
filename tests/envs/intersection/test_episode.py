"""Vehicles enter, cross and leave as in SUMO, and are counted once."""

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from covering import quick_or_slow
from numpy.typing import NDArray
from played import begun

from headway.contracts import HeadwayError, StepResult, generator
from headway_envs.intersection.config import IntersectionConfig, RewardConfig
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.network import ROAD_M
from headway_envs.intersection.prepared import prepare
from headway_envs.sumo_simulation import libsumo

Open = Callable[..., Any]
FULL, NOTHING = np.full((1, 96, 1), 3, np.float32), np.zeros((1, 96, 1), np.float32)
SEED = np.array([3], np.uint64)
WILD = {"av_speed_mode": 0, "hdv_speed_mode": 1}
"""Speed modes without checks, for many crashes."""


def _metrics(env: IntersectionBatchedEnv, outcome: StepResult) -> dict[str, float]:
    return dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))


def test_the_roster_equals_sumos_vehicles(crossing: Open) -> None:
    env, sumo = crossing(horizon=700, **WILD), libsumo()
    env.reset(SEED)
    for _ in range(699):
        env.step(FULL)
        roster = env.bridge.roster
        assert set(roster.ids) == set(sumo.vehicle.getIDList())
        holders = {slot: vehicle for _, slot, vehicle in roster.automated}
        assert holders == {slot: held for slot, held in enumerate(roster.holder) if held}
        for row, vehicle in enumerate(roster.ids):
            lane, along = sumo.vehicle.getLaneID(vehicle), sumo.vehicle.getLanePosition(vehicle)
            assert roster.row[vehicle] == row
            assert roster.traffic.speed[row] == sumo.vehicle.getSpeed(vehicle)
            if "_in_" in lane:
                assert roster.traffic.position[row] == pytest.approx(along, abs=1e-9)
            elif "_out_" in lane:
                inside = env.prepared.network.link_length[roster.traffic.link[row]]
                assert roster.traffic.position[row] == pytest.approx(ROAD_M + inside + along, abs=1e-9)


def test_every_entered_vehicle_is_present_or_has_left_or_crashed(crossing: Open) -> None:
    env = begun(crossing(horizon=900, **WILD), 3)
    crashed = 0
    for _ in range(899):
        env.step(FULL)
        entered, arrived = env.counters.entered, env.counters.arrived
        crashed += len(env.crash_places)
        assert entered - arrived - crashed == len(env.bridge.roster)
    assert min(crashed, arrived) >= 4
    outcome, _ = env.step(NOTHING)
    metrics = _metrics(env, outcome)
    assert crashed / 2 <= metrics["collisions"] <= crashed + 2
    seconds = 90.0
    assert metrics["outflow_vph"] * seconds / 3600 == pytest.approx(arrived, abs=1)
    assert metrics["inflow_vph"] * seconds / 3600 == pytest.approx(entered, abs=1)
    assert metrics["efficiency"] == pytest.approx(metrics["outflow_vph"] / metrics["inflow_vph"])


def test_a_crash_among_humans_is_reported_in_one_step(crossing: Open) -> None:
    """Such a crash frees no slot."""
    env = begun(crossing(vph_per_lane_av=5, hdv_speed_mode=1, av_speed_mode=31), 3)
    steps = 0
    for _ in range(1400):
        before = env.counters.crashes
        env.step(NOTHING)
        assert bool(env.crash_places) == (env.counters.crashes > before)
        steps += bool(env.crash_places)
    assert steps >= 2


@pytest.mark.parametrize("at_exit", ["truncated", "terminated"])
def test_avs_that_leave_end_as_configured_with_their_last_observation(at_exit: str, crossing: Open) -> None:
    env = crossing(horizon=700, at_exit=at_exit, **WILD)
    observed = env.reset(SEED)
    events = set()
    for _ in range(699):
        before = observed.observations[0].copy()
        outcome, observed = env.step(FULL)
        over = np.flatnonzero(outcome.terminated[0] | outcome.truncated[0])
        assert over.tolist() == sorted(env.events)
        for slot in over:
            events.add(env.events[slot])
            ended = "truncated" if env.events[slot] == "arrived" else "terminated"
            if at_exit == "terminated":
                ended = "terminated"
            assert getattr(outcome, ended)[0, slot]
            assert outcome.acting[0, slot]
            assert not observed.alive[0, slot]
            np.testing.assert_array_equal(outcome.final_observations[0, slot], before[slot])
    assert events == {"arrived", "collided"}


def _actions_for(env: IntersectionBatchedEnv, interval: int, there: frozenset[str]) -> NDArray[np.float32]:
    """Return the action of each vehicle in `there` for an interval, independent of its slot."""
    actions = NOTHING.copy()
    for _, slot, vehicle in env.bridge.roster.automated:
        if vehicle in there:
            actions[0, slot] = generator(int(vehicle.rsplit(".")[-1]), "asked", interval).uniform(-1, 3)
    return actions


@pytest.mark.parametrize("kind", quick_or_slow({kind: (kind,) for kind in ("team", "own", "paper")}, "own"))
def test_a_repeated_action_equals_the_same_action_at_every_step(kind: str, crossing: Open) -> None:
    """The equality is for vehicles present when the action was chosen; later ones keep their speed. The two
    runs are sequential, because a process holds one simulation."""
    repeat, intervals, ends, places, sums = 5, 130, [], [], []
    reward = RewardConfig(kind="paper") if kind == "paper" else RewardConfig(scope=kind)
    for action_repeat in (repeat, 1):
        env = crossing(horizon=repeat * intervals - 2, action_repeat=action_repeat, reward=reward, **WILD)
        env.reset(SEED)
        traffic, rewards, ended = [], [], dict.fromkeys(("arrived", "collided"), 0)
        for interval in range(intervals):
            slot_of = {vehicle: slot for _, slot, vehicle in env.bridge.roster.automated}
            there, paid = frozenset(slot_of), 0.0
            for _ in range(repeat // action_repeat):
                outcome, _ = env.step(_actions_for(env, interval, there))
                # The team's reward, or the sum over the vehicles present.
                slots = [0] if kind == "team" else list(slot_of.values())
                paid += float(outcome.rewards[0, slots].sum())
                still = {vehicle for _, _, vehicle in env.bridge.roster.automated}
                slot_of = {vehicle: slot for vehicle, slot in slot_of.items() if vehicle in still}
                for slot, event in env.events.items():
                    ended[event] += bool(outcome.acting[0, slot])
                if outcome.episode_ended[0]:
                    break
            roster = env.bridge.roster
            traffic.append((roster.ids.copy(), roster.traffic.speed[: len(roster)].tolist()))
            rewards.append(paid)
        assert outcome.episode_ended[0]
        metrics = _metrics(env, outcome)
        del metrics["paper_return"]  # depends on the number of acting AVs
        places.append((traffic[:-1], metrics))
        sums.append(rewards)
        ends.append(ended)
        env.close()
    assert places[0] == places[1]
    np.testing.assert_allclose(sums[0], sums[1], rtol=1e-5, atol=1e-4)
    # A vehicle that enters and crashes within an interval has never acted.
    assert 0 < ends[0]["collided"] <= ends[1]["collided"]
    assert 0 < ends[0]["arrived"] <= ends[1]["arrived"]


def test_an_av_that_leaves_within_a_repeated_action_ends_once_and_frees_its_slot(crossing: Open) -> None:
    env = crossing(horizon=900, action_repeat=6, reward=RewardConfig(scope="own"), **WILD)
    observed, left = env.reset(SEED), 0
    for _ in range(149):
        outcome, observed = env.step(FULL)
        over = outcome.terminated[0] | outcome.truncated[0]
        assert not (over & observed.alive[0]).any()
        assert not (over & ~outcome.acting[0]).any()
        assert set(np.flatnonzero(over)) <= set(env.events)
        assert (outcome.rewards[0, outcome.terminated[0]] < -20).all()
        left += over.sum()
    assert left > 20


def test_the_horizon_truncates_all_and_the_next_episode_is_another(crossing: Open) -> None:
    env = begun(crossing(horizon=60), 3)
    seen = []
    for _ in range(2):
        for _ in range(60):
            outcome, observed = env.step(NOTHING)
        assert outcome.episode_ended[0]
        assert outcome.truncated.all()
        assert not outcome.terminated.any()
        assert not observed.alive.any()
        seen.append(outcome.final_states.copy())
    assert (seen[0] != seen[1]).any()


def test_a_collision_ends_the_episode_if_configured(crossing: Open) -> None:
    env = begun(crossing(on_collision="end_episode", **WILD), 3)
    outcome, _ = env.step(FULL)
    while not outcome.episode_ended[0]:
        outcome, _ = env.step(FULL)
    assert outcome.terminated.all()
    assert not outcome.truncated.any()
    assert _metrics(env, outcome)["collisions"] >= 1


def test_vehicles_beyond_the_slots_are_driven_by_sumo_and_counted(crossing: Open) -> None:
    env = begun(crossing(slots=2, horizon=500), 3)
    most = 0
    for _ in range(500):
        outcome, observed = env.step(np.zeros((1, 2, 1), np.float32))
        most = max(most, observed.alive.sum())
    metrics = _metrics(env, outcome)
    assert most == 2
    assert metrics["avs_without_slot"] > 0
    assert metrics["avs"] > metrics["avs_without_slot"]


def test_noise_of_human_drivers_depends_on_the_seed(crossing: Open) -> None:
    def speeds(noise: float, seed: int) -> list[float]:
        env = crossing(human_noise=noise, horizon=150)
        env.reset(np.array([seed], np.uint64))
        for _ in range(149):
            env.step(NOTHING)
        given = env.bridge.roster.traffic.speed[: len(env.bridge.roster)].tolist()
        env.close()
        return given

    assert speeds(0.2, 1) == speeds(0.2, 1)
    assert speeds(0.2, 1) != speeds(0.0, 1)
    assert speeds(0.2, 1) != speeds(0.2, 2)


def test_a_process_holds_one_simulation(crossing: Open) -> None:
    first, second = crossing(), crossing()
    first.reset(SEED)
    with pytest.raises(HeadwayError, match="already holds a SUMO simulation, and can hold only one: close"):
        second.reset(SEED)
    first.step(NOTHING)
    first.close()
    second.reset(SEED)
    second.step(NOTHING)
    with pytest.raises(HeadwayError, match="can hold 1 copy of the intersection, not 2"):
        IntersectionBatchedEnv(prepare(IntersectionConfig()), 2)


def test_a_deleted_environment_releases_the_simulation(crossing: Open) -> None:
    env = IntersectionBatchedEnv(prepare(IntersectionConfig()), 1)
    env.reset(SEED)
    del env
    crossing().reset(SEED)


def test_without_sumo_the_error_names_the_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("headway_envs.sumo_simulation.find_spec", lambda name: None)
    line = r'the environment needs SUMO, which is not installed: pip install "headway\[sumo\]"$'
    with pytest.raises(HeadwayError, match=line):
        prepare(IntersectionConfig())
    assert importlib.util.find_spec("libsumo") is not None


def test_resets_do_not_leak_memory(crossing: Open) -> None:
    """Small version of the thousand resets in `python -m benchmarks crossing`."""

    def resident_kb() -> int:
        with open("/proc/self/status") as status:  # noqa: PTH123 - read while nothing else is allocated
            return next(int(line.split()[1]) for line in status if line.startswith("VmRSS:"))

    env = begun(crossing(horizon=5), 3)
    for _ in range(5 * 60):
        env.step(NOTHING)
    before = resident_kb()
    for _ in range(5 * 120):
        env.step(NOTHING)
    assert resident_kb() - before < 3000

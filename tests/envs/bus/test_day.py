"""Invariants of every day, for any actions."""

import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from played import begun, repeated

from headway.contracts import Discrete, HeadwayError
from headway_envs.bus.config import BusConfig, UpkeepConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import AWAY, BROKEN, DEPOT, MOVE, SERVICE_CENTER, WAIT
from headway_envs.bus.kernel.spacing import COUNTED
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared


def _actions(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return random actions: mostly MOVE, some WAIT and few SERVICE_CENTER."""
    return rng.choice(3, shape, p=[0.25, 0.745, 0.005]).astype(np.int64)


def test_passengers_are_conserved_and_buses_never_overfull(line: Prepared) -> None:
    env, rng = begun(BusBatchedEnv(line, 3)), np.random.default_rng(1)
    slots, world = len(line.agents), env.world
    before = np.zeros_like(world.event_time)
    for tick in range(line.config.ticks - 1):
        env.step(_actions(rng, (3, slots)))
        load = world.slots["load"]
        assert load.min() >= 0
        assert load.max() <= line.config.capacity
        out = world.event_time
        now = world.days["now"]
        assert np.all(now == line.config.start_hour * 3600 + (tick + 1) * 60)
        assert np.all(out >= now[:, None]), "an event was left behind"
        assert np.all(out >= before), "an event moved back in time"
        before = out.copy()
        if tick % 50 == 0:
            day = world.days
            assert np.all(day["boarded"] == day["alighted"] + load.sum(axis=1))
            waiting = world.queues["waiting"].sum(axis=1)
            assert np.all(day["arrived"] == day["boarded"] + waiting + day["lost"])
            assert np.all(world.queues["denied"] <= world.queues["waiting"])
    assert np.all(world.days["boarded"] > 1000)
    assert np.all(world.waits.sum(axis=1) == world.days["boarded"])


def test_queues_hold_past_arrivals_in_order(line: Prepared) -> None:
    env = begun(BusBatchedEnv(line, 1))
    repeated(env, MOVE, 200)
    now = env.world.days["now"][0]
    for call, first in enumerate(line.network.queue_first[:-1]):
        waiting = int(env.world.queues["waiting"][0, call])
        arrived = env.world.arrived_at[0, first : first + waiting]
        assert np.all(arrived <= now)
        assert np.all(np.diff(arrived) >= 0)
        assert np.all(env.world.leaves_at[0, first : first + waiting] > now)


@pytest.mark.parametrize("old", [False, True])
def test_a_snapshot_continues_bit_for_bit(line: Prepared, old: bool) -> None:
    """It holds only waiting passengers of the queues; older ones, which held the whole storage, are read."""
    env, rng = begun(BusBatchedEnv(line, 2)), np.random.default_rng(2)
    script = _actions(rng, (400, 2, len(line.agents)))
    for actions in script[:200]:
        env.step(actions)
    saved, waiting = pickle.loads(pickle.dumps(env.snapshot())), int(env.world.queues["waiting"].sum())
    assert 0 < waiting < env.world.arrived_at.size / 10
    for name in ("arrived_at", "leaves_at"):
        assert saved["world"][name].shape == (waiting,)
        if old:
            saved["world"][name] = getattr(env.world, name).copy()
    other = BusBatchedEnv(pickle.loads(pickle.dumps(line)), 2)
    assert np.array_equal(other.restore(saved).observations, saved["outputs"]["observations"])
    for actions in script[200:]:
        env.step(actions)
        other.step(actions)
    reached = other.snapshot()
    for part, arrays in env.snapshot().items():
        for name, array in arrays.items():
            assert array.tobytes() == reached[part][name].tobytes(), f"{part}.{name}"


def test_snapshot_of_another_batch_is_refused(line: Prepared) -> None:
    with pytest.raises(HeadwayError, match="number of copies"):
        begun(BusBatchedEnv(line, 2)).restore(begun(BusBatchedEnv(line, 1)).snapshot())
    for name in ("queues", "arrived_at"):
        lacking = begun(BusBatchedEnv(line, 2)).snapshot()
        del lacking["world"][name]
        with pytest.raises(HeadwayError, match="the snapshot is of another"):
            begun(BusBatchedEnv(line, 2)).restore(lacking)


def test_two_controllers_meet_the_same_day(line: Prepared) -> None:
    """Arrivals, demand and congestion are keyed draws, so holding changes none of them."""
    moving, holding = begun(BusBatchedEnv(line, 1)), begun(BusBatchedEnv(line, 1))
    for tick in range(600):
        repeated(moving, MOVE, 1)
        repeated(holding, tick % 2, 1)
    assert np.array_equal(moving.world.congestion, holding.world.congestion)
    assert np.array_equal(moving.world.queues["drawn"], holding.world.queues["drawn"])
    came = [env.world.days["arrived"] - env.world.days["requeued"] for env in (moving, holding)]
    assert np.array_equal(came[0], came[1])
    assert not np.array_equal(moving.world.event_time, holding.world.event_time)


def test_dead_slots_are_zeros_and_their_actions_ignored(line: Prepared) -> None:
    first, second = begun(BusBatchedEnv(line, 1)), begun(BusBatchedEnv(line, 1))
    slots, rng, seen_dead = len(line.agents), np.random.default_rng(4), 0
    alive = first.observed().alive.copy()
    for _ in range(500):
        actions = np.ones((1, slots), np.int64)
        other = np.where(alive, actions, rng.integers(0, 3, (1, slots)))
        outcome, observed = first.step(actions)
        second.step(other)
        assert not outcome.acting[~alive].any()
        alive = observed.alive.copy()
        assert np.array_equal(observed.observations, second.observed().observations)
        assert not observed.observations[~alive].any()
        seen_dead += int((~alive).sum())
    assert seen_dead > 100


def test_service_is_masked_while_away_and_ends_with_a_full_tank() -> None:
    for_all = prepare(BusConfig(upkeep=UpkeepConfig(service_below=1.0)))
    env = begun(BusBatchedEnv(for_all, 1))
    repeated(env, MOVE, 120)
    repeated(env, SERVICE_CENTER, 3)
    masks = env.observed().action_masks
    assert masks is not None
    assert masks[..., MOVE].all()
    away = ~masks[..., SERVICE_CENTER]
    assert away.sum() > 3
    assert np.all(env.world.slots["regularity"][away] <= 0)
    repeated(env, MOVE, 60)
    assert env.world.days["visits"][0] >= away.sum()
    assert env.world.slots["fuel"][away].min() > 70


def test_the_centre_accepts_worn_buses_only() -> None:
    """With SERVICE_CENTER at every step, buses go to service only when they are worn."""
    config = BusConfig(upkeep=UpkeepConfig(service_below=0.6))
    prepared = prepare(config)
    env = begun(BusBatchedEnv(prepared, 1))
    slots, sent = env.world.slots, 0
    for _ in range(config.ticks - 1):
        before = slots.copy()
        masks = env.observed().action_masks
        assert masks is not None
        level = np.minimum(slots["fuel"] / config.upkeep.fuel_capacity, slots["uptime"])
        alive, idle = env.observed().alive, np.isin(slots["phase"], [AWAY, BROKEN, DEPOT])
        assert np.array_equal(masks[..., SERVICE_CENTER], ~alive | ~idle & (level < 0.6))
        repeated(env, SERVICE_CENTER, 1)
        left = (slots["phase"] == AWAY) & ~np.isin(before["phase"], [AWAY, BROKEN])
        assert np.all(level[left] < 0.61)
        sent += int(left.sum())
    assert 14 < sent < 3 * 14


def test_a_day_ends_terminated_and_the_next_begins(line: Prepared) -> None:
    env = begun(BusBatchedEnv(line, 2))
    for tick in range(line.config.ticks):
        outcome = repeated(env, MOVE, 1)
        assert outcome.episode_ended.all() == (tick == line.config.ticks - 1)
    assert outcome.terminated.all()
    assert not outcome.truncated.any()
    metrics = dict(zip(env.spec.metrics, outcome.metrics.T, strict=True))
    assert np.all((metrics["mean_wait_min"] > 1) & (metrics["mean_wait_min"] < 30))
    assert np.all(metrics["p95_wait_min"] > metrics["mean_wait_min"])
    assert np.all(env.world.days["episode"] == 1)
    assert np.all(env.world.days["now"] == line.config.start_hour * 3600)
    assert np.all(env.world.slots["load"] == 0)


@pytest.mark.parametrize(
    ("observation", "size", "state"),
    [("paper", 4, "auto"), ("published", 8, "aggregate"), ("control", 29, "full"), ("network", 33, "full")],
)
def test_spaces_match_the_spec(line: Prepared, observation: str, size: int, state: str) -> None:
    config = replace(line.config, observation=observation, state=state)
    env = begun(BusBatchedEnv(replace(line, config=config), 2))
    spec = env.spec
    assert spec.observation_size == size
    assert spec.action_space == Discrete(3)
    assert spec.num_agents == len(spec.groups) == 14
    assert spec.state_size == 13 + (0 if state == "aggregate" else 14 * size)
    for _ in range(300):
        outcome, observed = env.step(np.ones((2, 14), np.int64))
        assert observed.observations.shape == (2, 14, size)
        assert observed.observations.dtype == np.float32
        assert np.isfinite(observed.observations).all()
        assert np.isfinite(observed.states).all()
        assert np.abs(observed.observations).max() <= (5 if observation in ("control", "network") else 1)
        assert observed.states.shape == (2, spec.state_size)
        assert np.isfinite(outcome.rewards).all()


def test_own_rewards_differ_and_are_zero_at_the_depot(line: Prepared) -> None:
    env = begun(BusBatchedEnv(_with_reward(line, scope="own"), 1))
    outcome = repeated(env, MOVE, 300)
    depot = env.world.slots["phase"] == DEPOT
    assert not outcome.rewards[depot].any()
    assert len(np.unique(outcome.rewards[~depot])) > 1


def test_scaled_service_pays_each_bus_the_lines_as_often_as_it_has_buses(line: Prepared) -> None:
    """A line's mean over its buses, times their number, changes by that much if its q changes."""
    alone = {"efficiency": 0.0, "maintenance": 0.0, "regularity": 0.0}
    own = begun(BusBatchedEnv(_with_reward(line, scope="own", scale_service=True, **alone), 1))
    whole = begun(BusBatchedEnv(_with_reward(line, scope="line", **alone), 1))
    numbers = set()
    for _ in range(40):
        of_buses, of_line = (repeated(env, MOVE, 20).rewards[0] for env in (own, whole))
        out = own.world.slots["phase"][0] != DEPOT
        numbers.add(int(out.sum()))
        np.testing.assert_allclose(of_buses[out], out.sum() * of_line[out], rtol=1e-5)
        assert not of_buses[~out].any()
    assert len(numbers) > 5


def _with_reward(line: Prepared, **changes: object) -> Prepared:
    return replace(line, config=replace(line.config, reward=replace(line.config.reward, **changes)))


def _day_of_rewards(env: BusBatchedEnv, seed: int) -> NDArray[np.float64]:
    """Return each slot's return (N,) of a day with random MOVE and WAIT, and occasional service."""
    random, total = np.random.default_rng(seed), np.zeros(14)
    for _ in range(env.prepared.config.ticks):
        actions = random.choice([WAIT, MOVE, SERVICE_CENTER], size=(1, 14), p=[0.2, 0.79, 0.01])
        outcome, _ = env.step(actions)
        total += outcome.rewards[0]
    return total


def test_line_rewards_differ_and_average_to_the_teams() -> None:
    """All slots of a line, also at the depot, receive the same; lines differ; and the mean over all slots is
    the team's reward."""
    corridor = prepare(BusConfig(scenario="corridor"))
    slots = len(corridor.agents)
    team, lines = (begun(BusBatchedEnv(_with_reward(corridor, scope=scope), 1)) for scope in ("team", "line"))
    assert lines.spec.shared_in_groups
    assert not team.spec.shared_in_groups
    rng, different = np.random.default_rng(0), 0
    for _ in range(200):
        actions = _actions(rng, (1, slots))
        of_team, _ = team.step(actions)
        of_lines, _ = lines.step(actions)
        paid = of_lines.rewards[0].astype(np.float64)
        assert np.mean(paid) == pytest.approx(of_team.rewards[0, 0], abs=1e-5)
        firsts = corridor.network.line_slots
        of_each = [set(paid[first:last]) for first, last in itertools.pairwise(firsts)]
        assert all(len(rewards) == 1 for rewards in of_each)
        different += len(set.union(*of_each)) > 1
    assert different > 150


@pytest.mark.parametrize("scope", ["team", "line", "own"])
def test_foreseen_upkeep_adds_the_same_to_every_day(line: Prepared, scope: str) -> None:
    """For any actions, a slot's return changes by minus its initial potential, which keeps the ranking of
    policies; rewards of single intervals change."""
    plain, foreseeing = (_with_reward(line, scope=scope, foresee_upkeep=foresee) for foresee in (False, True))
    env = begun(BusBatchedEnv(foreseeing, 1))
    owed = -env.world.slots["upkeep_ahead"][0]
    assert owed.max() > 10
    expected = owed if scope == "own" else np.full(14, owed.mean())
    before, after = (_day_of_rewards(begun(BusBatchedEnv(each, 1)), 0) for each in (plain, foreseeing))
    assert after - before == pytest.approx(expected, abs=0.01)


def test_foreseen_upkeep_is_refunded_when_a_worn_bus_goes_to_service(line: Prepared) -> None:
    env = begun(BusBatchedEnv(_with_reward(line, scope="own", foresee_upkeep=True), 1))
    actions = np.full((1, 14), MOVE)
    repeated(env, MOVE, 60 * 8)
    owed = -env.world.slots["upkeep_ahead"][0]
    n = int(owed.argmax())
    assert owed[n] > 10
    actions[0, n] = SERVICE_CENTER
    for _ in range(10):
        outcome, _ = env.step(actions)
        if env.world.slots["phase"][0, n] == AWAY:
            break
    assert outcome.rewards[0, n] > 0.5 * owed[n]


def test_the_follower_share_rewards_the_spacing_behind(line: Prepared) -> None:
    """The reward of the bus ahead rises by weight x share x (the follower's c - its own); others keep
    theirs."""
    played = (_with_reward(line, scope="own", follower_share=share) for share in (0.0, 0.25))
    own, mixed = (begun(BusBatchedEnv(prepared, 1)) for prepared in played)
    actions, moved = np.full((1, 14), MOVE), 0
    for _ in range(400):
        before, _ = own.step(actions)
        after, _ = mixed.step(actions)
        slots = own.world.slots[0]
        expected = before.rewards[0].astype(np.float64)
        for n in range(14):
            leader = slots["leader"][n]
            if slots["counted"][n] == COUNTED and leader >= 0:
                more = slots["regularity"][n] - slots["regularity"][leader]
                expected[leader] += line.config.reward.regularity * 0.25 * more
                moved += more != 0
        assert after.rewards[0] == pytest.approx(expected, abs=1e-5)
    assert moved > 1000


def test_always_moving_does_not_depend_on_the_control_interval() -> None:
    """With constant MOVE all events have the same exact times for any tick_s, including departures from the
    depot."""
    boarded, times = [], []
    for tick_s in (30.0, 60.0, 300.0):
        env = begun(BusBatchedEnv(prepare(BusConfig(tick_s=tick_s)), 1))
        repeated(env, MOVE, int(8 * 3600 / tick_s))
        times.append(env.world.event_time.copy())
        boarded.append(int(env.world.days["boarded"][0]))
    assert np.array_equal(times[0], times[1])
    assert np.array_equal(times[1], times[2])
    assert boarded[0] == boarded[1] == boarded[2]

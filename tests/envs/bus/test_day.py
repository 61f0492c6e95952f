"""Invariants of every day, for any actions."""

import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.contracts import Discrete, HeadwayError
from headway_envs.bus.config import BusConfig, UpkeepConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import AWAY, BROKEN, DEPOT, MOVE, SERVICE_CENTER, WAIT
from headway_envs.bus.kernel.spacing import COUNTED
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared


def _begun(prepared: Prepared, copies: int, seed: int = 0) -> BusBatchedEnv:
    env = BusBatchedEnv(prepared, copies)
    env.reset(np.arange(seed, seed + copies, dtype=np.uint64))
    return env


def _actions(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return random actions: mostly MOVE, some WAIT and few SERVICE_CENTER."""
    return rng.choice(3, shape, p=[0.25, 0.745, 0.005]).astype(np.int64)


def test_passengers_are_conserved_and_buses_never_overfull(line: Prepared) -> None:
    env, rng = _begun(line, 3), np.random.default_rng(1)
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
    env = _begun(line, 1)
    for _ in range(200):
        env.step(np.ones((1, len(line.agents)), np.int64))
    now = env.world.days["now"][0]
    for call, first in enumerate(line.network.queue_first[:-1]):
        waiting = int(env.world.queues["waiting"][0, call])
        arrived = env.world.arrived_at[0, first : first + waiting]
        assert np.all(arrived <= now)
        assert np.all(np.diff(arrived) >= 0)
        assert np.all(env.world.leaves_at[0, first : first + waiting] > now)


def test_snapshot_restores_bit_for_bit(line: Prepared) -> None:
    env, rng = _begun(line, 2), np.random.default_rng(2)
    script = _actions(rng, (400, 2, len(line.agents)))
    for actions in script[:200]:
        env.step(actions)
    saved = pickle.loads(pickle.dumps(env.snapshot()))
    for actions in script[200:]:
        env.step(actions)
    expected = env.snapshot()
    other = BusBatchedEnv(pickle.loads(pickle.dumps(line)), 2)
    observed = other.restore(saved)
    assert np.array_equal(observed.observations, saved["outputs"]["observations"])
    for actions in script[200:]:
        other.step(actions)
    reached = other.snapshot()
    for part, arrays in expected.items():
        for name, array in arrays.items():
            assert array.tobytes() == reached[part][name].tobytes(), f"{part}.{name}"


def test_a_snapshot_holds_only_waiting_passengers_of_the_queues(line: Prepared) -> None:
    env, rng = _begun(line, 2), np.random.default_rng(2)
    for actions in _actions(rng, (200, 2, len(line.agents))):
        env.step(actions)
    world, storage = env.snapshot()["world"], env.world.arrived_at.size
    waiting = int(env.world.queues["waiting"].sum())
    assert 0 < waiting < storage / 10
    assert world["arrived_at"].shape == world["leaves_at"].shape == (waiting,)


def test_an_older_snapshot_with_the_whole_queue_storage_is_restored(line: Prepared) -> None:
    env, rng = _begun(line, 2), np.random.default_rng(2)
    script = _actions(rng, (300, 2, len(line.agents)))
    for actions in script[:200]:
        env.step(actions)
    saved = env.snapshot()
    for name in ("arrived_at", "leaves_at"):
        saved["world"][name] = getattr(env.world, name).copy()
    other = BusBatchedEnv(line, 2)
    other.restore(saved)
    for actions in script[200:]:
        env.step(actions)
        other.step(actions)
    assert env.world.days.tobytes() == other.world.days.tobytes()
    assert np.array_equal(env.outputs.observations, other.outputs.observations)


def test_snapshot_of_another_batch_is_refused(line: Prepared) -> None:
    with pytest.raises(HeadwayError, match="number of copies"):
        _begun(line, 2).restore(_begun(line, 1).snapshot())
    for name in ("queues", "arrived_at"):
        lacking = _begun(line, 2).snapshot()
        del lacking["world"][name]
        with pytest.raises(HeadwayError, match="the snapshot is of another"):
            _begun(line, 2).restore(lacking)


def test_copies_depend_on_their_seed_alone(line: Prepared) -> None:
    one, many = _begun(line, 1, seed=7), _begun(line, 4, seed=5)
    rng = np.random.default_rng(3)
    for _ in range(line.config.ticks + 20):
        actions = _actions(rng, (4, len(line.agents)))
        few, seen = one.step(actions[2:3])
        all_, all_seen = many.step(actions)
        assert np.array_equal(few.rewards[0], all_.rewards[2])
        assert np.array_equal(seen.observations[0], all_seen.observations[2])
        assert np.array_equal(seen.states[0], all_seen.states[2])
    assert not np.array_equal(all_seen.observations[1], all_seen.observations[2])


def test_two_controllers_meet_the_same_day(line: Prepared) -> None:
    """Arrivals, demand and congestion are keyed draws, so holding changes none of them."""
    moving, holding = _begun(line, 1), _begun(line, 1)
    slots = len(line.agents)
    for tick in range(600):
        moving.step(np.ones((1, slots), np.int64))
        holding.step(np.full((1, slots), tick % 2, np.int64))
    assert np.array_equal(moving.world.congestion, holding.world.congestion)
    assert np.array_equal(moving.world.queues["drawn"], holding.world.queues["drawn"])
    came = [env.world.days["arrived"] - env.world.days["requeued"] for env in (moving, holding)]
    assert np.array_equal(came[0], came[1])
    assert not np.array_equal(moving.world.event_time, holding.world.event_time)


def test_dead_slots_are_zeros_and_their_actions_ignored(line: Prepared) -> None:
    first, second = _begun(line, 1), _begun(line, 1)
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
    env = _begun(for_all, 1)
    slots = len(for_all.agents)
    for _ in range(120):
        env.step(np.ones((1, slots), np.int64))
    for _ in range(3):
        env.step(np.full((1, slots), SERVICE_CENTER))
    masks = env.observed().action_masks
    assert masks is not None
    assert masks[..., MOVE].all()
    away = ~masks[..., SERVICE_CENTER]
    assert away.sum() > 3
    assert np.all(env.world.slots["regularity"][away] <= 0)
    for _ in range(60):
        env.step(np.ones((1, slots), np.int64))
    assert env.world.days["visits"][0] >= away.sum()
    assert env.world.slots["fuel"][away].min() > 70


def test_the_centre_accepts_worn_buses_only() -> None:
    """With SERVICE_CENTER at every step, buses go to service only when they are worn."""
    config = BusConfig(upkeep=UpkeepConfig(service_below=0.6))
    prepared = prepare(config)
    env, order = _begun(prepared, 1), np.full((1, 14), SERVICE_CENTER)
    slots, sent = env.world.slots, 0
    for _ in range(config.ticks - 1):
        before = slots.copy()
        masks = env.observed().action_masks
        assert masks is not None
        level = np.minimum(slots["fuel"] / config.upkeep.fuel_capacity, slots["uptime"])
        alive, idle = env.observed().alive, np.isin(slots["phase"], [AWAY, BROKEN, DEPOT])
        assert np.array_equal(masks[..., SERVICE_CENTER], ~alive | ~idle & (level < 0.6))
        env.step(order)
        left = (slots["phase"] == AWAY) & ~np.isin(before["phase"], [AWAY, BROKEN])
        assert np.all(level[left] < 0.61)
        sent += int(left.sum())
    assert 14 < sent < 3 * 14


def test_a_day_ends_terminated_and_the_next_begins(line: Prepared) -> None:
    env = _begun(line, 2)
    actions = np.ones((2, len(line.agents)), np.int64)
    for tick in range(line.config.ticks):
        outcome, observed = env.step(actions)
        assert outcome.episode_ended.all() == (tick == line.config.ticks - 1)
    assert outcome.terminated.all()
    assert not outcome.truncated.any()
    metrics = dict(zip(env.spec.metrics, outcome.metrics.T, strict=True))
    assert np.all((metrics["mean_wait_min"] > 1) & (metrics["mean_wait_min"] < 30))
    assert np.all(metrics["p95_wait_min"] > metrics["mean_wait_min"])
    assert np.all(env.world.days["episode"] == 1)
    assert np.all(env.world.days["now"] == line.config.start_hour * 3600)
    assert np.all(env.world.slots["load"] == 0)
    assert observed.observations.shape == (2, 14, env.spec.observation_size)


@pytest.mark.parametrize(("observation", "size"), [("paper", 4), ("published", 8), ("control", 29)])
@pytest.mark.parametrize("state", ["auto", "full", "aggregate"])
def test_spaces_match_the_spec(line: Prepared, observation: str, size: int, state: str) -> None:
    config = replace(line.config, observation=observation, state=state)
    env = _begun(replace(line, config=config), 2)
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
        assert np.abs(observed.observations).max() <= (5 if observation == "control" else 1)
        assert observed.states.shape == (2, spec.state_size)
        assert np.isfinite(outcome.rewards).all()


def test_own_rewards_differ_and_are_zero_at_the_depot(line: Prepared) -> None:
    reward = replace(line.config.reward, scope="own")
    env = _begun(replace(line, config=replace(line.config, reward=reward)), 1)
    for _ in range(300):
        outcome, _ = env.step(np.ones((1, 14), np.int64))
    depot = env.world.slots["phase"] == DEPOT
    assert not outcome.rewards[depot].any()
    assert len(np.unique(outcome.rewards[~depot])) > 1


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
    team, lines = (_begun(_with_reward(corridor, scope=scope), 1) for scope in ("team", "line"))
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
    env = _begun(foreseeing, 1)
    owed = -env.world.slots["upkeep_ahead"][0]
    assert owed.max() > 10
    expected = owed if scope == "own" else np.full(14, owed.mean())
    difference = _day_of_rewards(_begun(foreseeing, 1), 0) - _day_of_rewards(_begun(plain, 1), 0)
    assert difference == pytest.approx(expected, abs=0.01)


def test_foreseen_upkeep_is_refunded_when_a_worn_bus_goes_to_service(line: Prepared) -> None:
    env = _begun(_with_reward(line, scope="own", foresee_upkeep=True), 1)
    actions = np.full((1, 14), MOVE)
    for _ in range(60 * 8):
        env.step(actions)
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
    own, mixed = (_begun(_with_reward(line, scope="own", follower_share=s), 1) for s in (0.0, 0.25))
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
        prepared = prepare(BusConfig(tick_s=tick_s))
        env = _begun(prepared, 1)
        for _ in range(int(8 * 3600 / tick_s)):
            env.step(np.ones((1, len(prepared.agents)), np.int64))
        times.append(env.world.event_time.copy())
        boarded.append(int(env.world.days["boarded"][0]))
    assert np.array_equal(times[0], times[1])
    assert np.array_equal(times[1], times[2])
    assert boarded[0] == boarded[1] == boarded[2]

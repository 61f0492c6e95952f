"""Branches share the present of their source and nothing of its future."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from played import first_episodes

from headway.contracts import Observations
from headway_envs.array_env import ArrayEnv
from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.registry import ENTRIES

Env = ArrayEnv[Any, Any]
STEPS = {"bus": 313, "bus_published": 20, "merge": 10, "merge_two_lane": 10}
NAMES = [name for name, entry in ENTRIES.items() if entry.lookahead is not None]
ROWS = np.array([2, 0, 0])


def seeds_from(first: int) -> NDArray[np.uint64]:
    return np.arange(first, first + 3, dtype=np.uint64)


def some_way(name: str) -> tuple[Env, Observations]:
    """Return three copies some way into their episodes, and what they show."""
    entry = ENTRIES[name]
    prepared = entry.prepare(entry.config())
    env = entry.make(prepared, 3)
    assert isinstance(env, ArrayEnv)
    rule = entry.rules[str(entry.lookahead)].make(prepared)
    observed = env.reset(seeds_from(7))
    for _ in range(STEPS[name]):
        _, observed = env.step(rule.act(env, observed))
    return env, observed


def branch(env: Env, rows: NDArray[np.int64], first: int) -> Env:
    entry = ENTRIES[env.spec.name]
    made = entry.make(entry.prepare(entry.config()), 3)
    assert isinstance(made, ArrayEnv)
    made.branch_from(env, rows, seeds_from(first))
    return made


def everything(env: Env) -> dict[str, bytes]:
    return {name: array.tobytes() for part in env.snapshot().values() for name, array in part.items()}


def later(env: Env) -> dict[str, bytes]:
    """Return everything after ten more steps in which every agent takes action 1."""
    for _ in range(10):
        env.step(np.ones((3, env.spec.num_agents), np.int64))
    return everything(env)


@pytest.mark.parametrize("name", NAMES)
def test_a_branch_begins_at_the_present_of_its_source(name: str) -> None:
    env, observed = some_way(name)
    shown = branch(env, ROWS, 50).observed()
    assert (shown.observations == observed.observations[ROWS]).all()
    assert (shown.alive == observed.alive[ROWS]).all()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_of_the_future_of_the_source_is_left(name: str) -> None:
    """A branch with seed b of a branch with seed a is a branch with seed b of the first source, in every
    array and to the last bit: nothing tells which future the one in between would have had."""
    env, _ = some_way(name)
    detour = branch(branch(env, np.arange(3), 400), ROWS, 50)
    direct = branch(env, ROWS, 50)
    assert everything(detour) == everything(direct)
    assert later(detour) == later(direct)


def test_everything_that_a_bus_day_draws_ahead_is_drawn_again() -> None:
    """Among the purposes of `draws`, ARRIVAL, DEMAND_HOUR, PATIENCE, TRIP, BREAKDOWN, EVENING and NETWORK are
    drawn before they show; DEMAND_DAY and COMPLIANCE hold for the day; all others are drawn when an event
    needs them, from the day's key."""
    env, _ = some_way("bus")
    assert isinstance(env, BusBatchedEnv)
    branched = branch(env, np.arange(3), 50)
    now, then = branched.world, env.world
    assert not np.isin(now.days["key"], then.days["key"]).any()
    assert not np.isin(now.days["seed"], then.days["seed"]).any()
    coming = np.isfinite(then.queues["next_arrival"])
    for field in ("next_arrival", "hour_factor"):
        assert (now.queues[field] != then.queues[field])[coming].all(), field
    assert coming.any()
    first = env.network.queue_first[:-1]
    heads = [now.leaves_at[c, first[now.queues["waiting"][c] > 0]] for c in range(3)]
    patience = np.concatenate([head[np.isfinite(head)] for head in heads])
    assert patience.size > 0
    assert not np.isin(patience, then.leaves_at).any()
    assert (now.slots["hazard_limit"] != then.slots["hazard_limit"]).all()
    driven = np.take_along_axis(then.departed, then.slots["trip"], axis=1)
    assert (driven == (now.slots["trip_factor"] == then.slots["trip_factor"])).all()
    assert driven.any()
    assert not driven.all()
    assert (now.congestion != then.congestion).all()


def test_the_present_level_of_congestion_is_kept_and_no_quarter_hour_around_it() -> None:
    """Between the quarter hours from 5:00 on, at which it is drawn, the level is linear."""
    env, _ = some_way("bus")
    assert isinstance(env, BusBatchedEnv)
    times, curves = env.world.days["now"], env.world.congestion
    knots = 5 * 3600.0 + 900.0 * np.arange(curves.shape[1])
    level = [np.interp(time, knots, curve) for time, curve in zip(times, curves, strict=True)]
    nearest = np.abs(times[:, None] - knots).argmin(axis=1)
    assert (np.abs(times - knots[nearest]) > 90.0).all()
    for seed in (50, 90):
        redrawn = branch(env, np.arange(3), seed).world.congestion
        kept = [np.interp(time, knots, curve) for time, curve in zip(times, redrawn, strict=True)]
        assert kept == pytest.approx(level, rel=1e-8)
        assert (np.abs(redrawn / curves - 1.0)[np.arange(3), nearest] > 1e-6).all()


def test_a_bus_has_another_future_with_another_seed() -> None:
    env, _ = some_way("bus")
    first, same, other = (later(branch(env, ROWS, seed)) for seed in (50, 50, 90))
    assert first == same
    for name in ("queues", "event_time", "congestion"):
        assert first[name] != other[name]
    source = everything(env)
    branch(env, ROWS, 50)
    assert everything(env) == source


def test_futures_of_a_bus_day_are_distributed_as_days_are() -> None:
    """Sixty days and their branches are played alike from noon on: means of waits, boardings and trip times
    agree within four standard errors."""
    entry, days = ENTRIES["bus"], 60
    prepared = entry.prepare(BusConfig())
    rule = entry.rules["even_headway"].make(prepared)
    env, branched = entry.make(prepared, days), entry.make(prepared, days)
    observed = env.reset(np.arange(days, dtype=np.uint64))
    for _ in range(420):
        _, observed = env.step(rule.act(env, observed))
    shown = branched.branch_from(env, np.arange(days), np.arange(1000, 1000 + days, dtype=np.uint64))
    real, imagined = first_episodes(env, rule, observed), first_episodes(branched, rule, shown)
    for name in ("mean_wait_min", "boardings", "in_vehicle_min", "headway_cv", "team_reward", "lost_share"):
        difference = imagined[name] - real[name]
        assert difference.std() > 0, name
        assert abs(difference.mean()) < 4 * difference.std(ddof=1) / np.sqrt(days), name

"""Decisions at stops, with holding times as actions, and the holding laws of the literature."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from pettingzoo.test import parallel_api_test
from played import first_episodes

from headway.contracts import Box, Discrete, child_seeds
from headway_envs.bus.config import BusConfig
from headway_envs.bus.entry import ENTRY
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.curves import interpolate
from headway_envs.bus.kernel.layout import DRIVING, STANDING, WAIT
from headway_envs.bus.parallel import BusParallelEnv
from headway_envs.bus.prepare import prepare
from headway_envs.bus.rules.fleet_state import FleetState
from headway_envs.bus.rules.literature import (
    ForwardHeadway,
    HoldingLaw,
    SelfCoordinating,
    SimpleControl,
    TwoWayHeadway,
)

DAYS = 20


def played(rule: str, config: BusConfig, days: int = DAYS) -> dict[str, NDArray[np.float64]]:
    """Return the metrics of days under a rule."""
    prepared = prepare(config)
    env = BusBatchedEnv(prepared, days)
    observed = env.reset(child_seeds(17, "days", 0, days))
    return first_episodes(env, ENTRY.rules[rule].make(prepared), observed)


def test_without_holding_the_day_is_that_of_the_rule_which_only_moves() -> None:
    """If buses decide at their scheduled departure and never hold, both controls give the same day, service
    included, to the last bit."""
    by_minute = played("move_with_service", BusConfig(dispatch_window_s=0.0), 3)
    for levels in (7, 0):
        config = BusConfig(dispatch_window_s=0.0, control="holding", hold_levels=levels)
        held = played("move_with_service", config, 3)
        for name, values in by_minute.items():
            np.testing.assert_array_equal(held[name], values, err_msg=name)
    assert by_minute["service_visits"].min() > 0


def test_seconds_and_levels_are_the_same_holding_times() -> None:
    levels = BusBatchedEnv(prepare(BusConfig(control="holding")), 2)
    seconds = BusBatchedEnv(prepare(BusConfig(control="holding", hold_levels=0)), 2)
    assert levels.spec.action_space == Discrete(7)
    assert seconds.spec.action_space == Box((0.0,), (180.0,))
    draw = np.random.default_rng(3)
    for env in (levels, seconds):
        assert env.reset(np.arange(2, dtype=np.uint64)).action_masks is None
    for _ in range(600):
        actions = draw.integers(0, 3, (2, levels.spec.num_agents))
        first, _ = levels.step(actions)
        rewards, acting = first.rewards.copy(), first.acting.copy()
        second, _ = seconds.step((30.0 * actions)[..., None].astype(np.float32))
        np.testing.assert_array_equal(second.rewards, rewards)
        np.testing.assert_array_equal(second.acting, acting)
    assert levels.world.days["held"].min() > 0


@pytest.mark.parametrize("levels", [7, 0])
def test_the_parallel_env_obeys_the_api(levels: int) -> None:
    parallel_api_test(BusParallelEnv(BusConfig(control="holding", hold_levels=levels, end_hour=7)), 150)


def expected_law(law: HoldingLaw, env: BusBatchedEnv, c: int, n: int) -> float:
    """Return a law's holding time for a bus at a stop, from its definition."""
    net, slot, now = env.network, env.world.slots[c, n], env.world.days["now"][c]
    event, last = env.world.event_time[c, n], env.world.queues["last_departure"][c, slot["call"]]
    target, ready = interpolate(net.target, slot["pattern"], event), event - slot["held"]
    shortfall, behind = target - (ready - last), now + slot["behind"] * target - ready
    match law:
        case ForwardHeadway(gain=gain, slack=slack):
            return float(slack + gain * shortfall)
        case TwoWayHeadway(gain=gain, slack=slack):
            return float(slack + gain * (behind - (ready - last)))
        case SelfCoordinating(gain=gain):
            return float(gain * behind)
        case SimpleControl(kept=kept, slack=slack):
            leaves = net.trip_departure[slot["trip"]]
            delay = ready - leaves - interpolate(net.nominal, slot["call"], leaves)
            beta = 3.0 * net.boarding_rate[slot["call"], int((event - 5 * 3600.0) // 900.0)]
            return float(slack - (1 - kept) * delay + kept * beta * shortfall)
    raise AssertionError(law)


@pytest.mark.parametrize("holds", [True, False])
@pytest.mark.parametrize(
    "name", ["forward_headway", "two_way_headway", "simple_control", "self_coordinating"]
)
def test_laws_hold_as_they_are_defined(name: str, holds: bool) -> None:
    """For that time or, if buses decide every minute, for as many minutes as are nearest to it."""
    config = BusConfig(control="holding", hold_levels=0) if holds else BusConfig()
    prepared = prepare(config)
    env, law = BusBatchedEnv(prepared, 2), ENTRY.rules[name].make(prepared)
    assert isinstance(law, HoldingLaw)
    observed, compared = env.reset(np.arange(2, dtype=np.uint64)), []
    for _ in range(400):
        actions, slots = law.act(env, observed), env.world.slots
        last = np.take_along_axis(env.world.queues["last_departure"], slots["call"], axis=1)
        # The bus ahead has left the stop: targets are above 100 s.
        left = slots["ahead"] * 100.0 > env.world.event_time - env.world.days["now"][:, None]
        known = (slots["phase"] == STANDING) & (last > 0) & left & ~np.isnan(slots["behind"])
        for c, n in np.argwhere(known & ((slots["held"] == 0) | (not holds))):
            seconds = expected_law(law, env, c, n)
            if holds:
                assert actions[c, n, 0] == pytest.approx(np.clip(seconds, 0.0, 180.0), abs=1e-3)
            else:
                assert (actions[c, n] == WAIT) == (seconds - slots["held"][c, n] > 30.0)
            compared.append(seconds)
        _, observed = env.step(actions)
    assert len(compared) > 300
    assert np.ptp(compared) > 10


def test_the_expected_dwell_of_a_driving_bus_is_right_on_average() -> None:
    """Rules decide for buses that reach a stop and leave it within one control interval."""
    env = BusBatchedEnv(prepare(BusConfig(control="holding", tick_s=120.0)), 2)
    env.reset(np.arange(2, dtype=np.uint64))
    errors, dwells = [], []
    for _ in range(300):
        slots, ready, call = env.world.slots, FleetState(env).ready, env.world.slots["call"].copy()
        driving, arrived = slots["phase"] == DRIVING, env.world.event_time.copy()
        env.step(np.zeros((2, env.spec.num_agents), np.int64))
        left = driving & (slots["phase"] == DRIVING) & (slots["call"] == call + 1)
        errors.append((slots["left"] - ready)[left])
        dwells.append((slots["left"] - arrived)[left])
    error, dwell = np.concatenate(errors), np.concatenate(dwells)
    assert abs(error.mean()) < 1.0
    assert error.std() < 0.8 * dwell.std()


@cache
def _held(rule: str) -> dict[str, NDArray[np.float64]]:
    return played(rule, BusConfig(control="holding"))


@pytest.mark.parametrize(
    "name", ["two_way_headway", "forward_headway", "simple_control", "self_coordinating", "even_headway"]
)
def test_holding_laws_make_headways_more_even_than_never_holding(name: str) -> None:
    """Also waits are shorter; by paired 95% intervals over days that exclude 0."""
    for metric in ("headway_cv", "mean_wait_min"):
        better = _held("always_move")[metric] - _held(name)[metric]
        assert better.mean() > 2.09 * better.std(ddof=1) / np.sqrt(DAYS), metric


def test_drivers_who_do_not_comply_are_never_held() -> None:
    """If no driver complies, the day is that without holding, and no action is used; rules and learners are
    alike."""
    config = BusConfig(control="holding", noncompliant_share=1.0)
    held, free = (
        played("two_way_headway", config, 3),
        played("move_with_service", BusConfig(control="holding"), 3),
    )
    for name, values in free.items():
        np.testing.assert_array_equal(held[name], values, err_msg=name)


def test_compliance_is_drawn_by_bus_and_day() -> None:
    env = BusBatchedEnv(prepare(BusConfig(control="holding", noncompliant_share=0.3)), 40)
    env.reset(child_seeds(5, "days", 0, 40))
    actions = np.full((40, env.spec.num_agents), 2)
    days, held = [], np.zeros(actions.shape)
    for _ in range(2):
        acted = np.zeros(actions.shape, np.int64)
        held[...] = 0.0
        for _ in range(env.prepared.config.ticks):
            result, _ = env.step(actions)
            acted += result.acting
            held = np.maximum(held, env.world.slots["held"])
        # Buses act at every stop of their trips, or never.
        assert ((acted == 0) | (acted > 20)).all()
        np.testing.assert_array_equal(held[acted == 0], 0.0)
        days.append(acted > 20)
    complies = np.stack(days)
    # The standard error of the share is 0.014, with 1,120 draws.
    assert abs(complies.mean() - 0.7) < 0.05
    assert (complies[0] != complies[1]).mean() == pytest.approx(2 * 0.3 * 0.7, abs=0.06)


def test_the_futures_of_a_day_have_its_drivers() -> None:
    """A simulated future keeps who complies that day: `lookahead` must not hold a bus that never holds."""
    envs = [BusBatchedEnv(prepare(BusConfig(control="holding", noncompliant_share=0.5)), 3) for _ in range(2)]
    source, branch = envs
    source.reset(child_seeds(5, "days", 0, 3))
    branch.branch_from(source, np.arange(3), child_seeds(6, "days", 0, 3))
    complies = source.world.slots["complies"]
    assert complies.any()
    assert not complies.all()
    np.testing.assert_array_equal(branch.world.slots["complies"], complies)

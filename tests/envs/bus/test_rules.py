"""Holding is better than never holding, on the same days."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from played import assert_allowed, first_episodes

from headway.contracts import child_seeds
from headway_envs.bus.config import BusConfig, UpkeepConfig
from headway_envs.bus.entry import ENTRY
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import SERVICE_CENTER, TERMINAL
from headway_envs.bus.prepared import Prepared

DAYS = 20
LINE1 = Path(__file__).parents[4] / "shared" / "data" / "sunt" / "line1"


@cache
def _metrics(scenario: str, rule_name: str) -> dict[str, np.ndarray]:
    prepared = ENTRY.prepare(BusConfig(scenario=scenario))
    env = ENTRY.make(prepared, DAYS)
    observed = env.reset(child_seeds(17, "days", 0, DAYS))
    return first_episodes(env, ENTRY.rules[rule_name].make(prepared), observed)


@pytest.mark.parametrize("mover", ["always_move", "move_with_service"])
@pytest.mark.parametrize("scenario", ["line", pytest.param(str(LINE1), marks=pytest.mark.data)])
def test_the_best_holding_rule_beats_always_moving(scenario: str, mover: str) -> None:
    """It is better in wait, headway variation and team reward, by paired 95% intervals over days that exclude
    0; also if both rules go to service alike, so that the difference is due to holding."""
    if scenario != "line" and not LINE1.is_dir():
        pytest.skip("the SUNT extract ../shared/data/sunt/line1 is not there")
    moving, holding = _metrics(scenario, mover), _metrics(scenario, "even_headway")
    for name, sign in (("mean_wait_min", -1), ("headway_cv", -1), ("team_reward", 1)):
        better = sign * (holding[name] - moving[name])
        margin = 2.09 * better.std(ddof=1) / np.sqrt(DAYS)
        assert better.mean() > margin, name


def test_buses_break_down_at_the_stated_rate_also_between_services() -> None:
    """Without growth by wear, the number is Poisson with the rate times the time at work, which the fuel
    measures if standing uses as much as driving."""
    upkeep = UpkeepConfig(breakdowns_per_hour=0.05, wear_growth=0.0, idle_share=1.0)
    prepared = ENTRY.prepare(BusConfig(upkeep=upkeep))
    env = ENTRY.make(prepared, DAYS)
    observed = env.reset(child_seeds(17, "days", 0, DAYS))
    metrics = first_episodes(env, ENTRY.rules["move_with_service"].make(prepared), observed)
    hours = metrics["fuel_used"].sum() * upkeep.seconds_per_fuel_unit / 3600.0
    expected = hours * upkeep.breakdowns_per_hour
    assert metrics["service_visits"].mean() > 1
    assert abs(metrics["breakdowns"].sum() - expected) < 3.0 * np.sqrt(expected)


def test_buses_go_to_service_near_a_centre_in_time_and_no_more_often_than_they_must(line: Prepared) -> None:
    """Hardly any bus runs out of fuel, and none goes that will reach the depot soon enough."""
    env, rule = ENTRY.make(line, 5), ENTRY.rules["move_with_service"].make(line)
    observed, net, visits = env.reset(child_seeds(17, "days", 0, 5)), env.network, 0
    nearest = net.detour[net.pattern_calls[:-1]].min()
    for _ in range(line.config.ticks):
        actions = rule.act(env, observed)
        slots = env.world.slots
        going = (actions == SERVICE_CENTER) & (slots["phase"] == TERMINAL)
        lasts_s = slots["fuel"] * line.config.upkeep.seconds_per_fuel_unit
        worn = slots["uptime"] < 0.5
        assert (going <= ((lasts_s < 1.3 * net.trip_work_left[slots["trip"]]) | worn)).all()
        far = net.detour[slots["call"]] > nearest + 60
        assert (going & far).sum() == 0
        visits += going.sum()
        outcome, observed = env.step(actions)
    metrics = dict(zip(env.spec.metrics, outcome.metrics.T, strict=True))
    assert visits > 10
    assert metrics["breakdowns"].mean() < 1


@pytest.mark.parametrize("name", sorted(ENTRY.rules))
def test_every_rule_acts_within_the_masks(line: Prepared, name: str) -> None:
    env, rule = ENTRY.make(line, 2), ENTRY.rules[name].make(line)
    observed = env.reset(np.arange(2, dtype=np.uint64))
    for _ in range(200):
        actions = rule.act(env, observed)
        assert_allowed(actions, observed)
        _, observed = env.step(actions)


def test_the_observation_of_a_network_shows_when_the_rules_go_to_service() -> None:
    """The rule's decision at terminals from observed numbers alone, in the units that the page on the
    environment states; `control` lacks two of them."""
    prepared = ENTRY.prepare(BusConfig(scenario="corridor", observation="network"))
    env, rule = BusBatchedEnv(prepared, 1), ENTRY.rules["move_with_service"].make(prepared)
    observed, upkeep, found = (
        env.reset(child_seeds(3, "days", 0, 1)),
        prepared.config.upkeep,
        np.zeros(2, int),
    )
    for _ in range(prepared.config.ticks - 1):
        actions = rule.act(env, observed)
        at_terminal = observed.alive & (env.world.slots["phase"] == TERMINAL)
        seen = observed.observations[at_terminal].astype(np.float64)
        assert (seen[:, 17] == 1).all()
        fuel_s = seen[:, 8] * upkeep.fuel_capacity * upkeep.seconds_per_fuel_unit / 1.25
        worn_s = (seen[:, 4] - upkeep.warning) * upkeep.uptime_hours * 3600
        trip_s, depot_s, near = seen[:, 29] * 3600, seen[:, 26] * 12 * 3600, seen[:, 32] * 300 <= 60
        fuel_due = np.minimum(np.where(near, 2, 1) * trip_s, depot_s) - fuel_s
        worn_due = np.where(near, np.minimum(2 * trip_s, 0.5 * depot_s) - worn_s, -np.inf)
        due = np.maximum(fuel_due, worn_due)
        clear = np.abs(due) > 1  # float32 rounds times of hours to milliseconds
        goes = actions[at_terminal] == SERVICE_CENTER
        assert ((due > 0) == goes)[clear].all()
        found += [goes.sum(), (~goes).sum()]
        _, observed = env.step(actions)
    assert found.min() > 20

"""Stop-skipping and boarding limits as actions: a naive loop over a hand-made line, masks and invariants."""

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from played import begun, first_episodes

from headway.contracts import Discrete, child_seeds
from headway_envs.bus.config import BusConfig, NoiseConfig
from headway_envs.bus.entry import ENTRY
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import DEPOT, DISPATCHED, DRIVING, SKIP_NEXT, STANDING
from headway_envs.bus.kernel.passengers import board, update_queue
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.tables import NO_LINK, Tables

CONFIG = BusConfig(control="holding", skipping=True, boarding_limit=0.4)
SKIP, LIMIT = 7, 8
"""Actions after the seven holding times."""
DEPARTURES = (18600.0, 19200.0, 19800.0)
STOPS = 6
EMPTIES = (3, 5)
"""Stops at which all passengers alight; at the others none does."""


def hand_made() -> Prepared:
    """Return a line of six stops, 100 s apart, with three buses, 240 passengers per hour and stop, and no
    noise."""
    calm = {name: 0.0 for name in vars(NoiseConfig()) if name != "incident_factor"}
    config = BusConfig(
        **{**vars(CONFIG), "end_hour": 6, "noise": NoiseConfig(**calm), "captive_share": 1.0, "capacity": 90}
    )
    frames = {
        "stops": {"stop": range(STOPS), "lat": 0.0, "lon": 0.01 * np.arange(STOPS)},
        "patterns": {"pattern": [0], "line": ["a"], "dir": ["I"], "n_stops": [STOPS]},
        "pattern_stops": {
            "pattern": 0,
            "seq0": range(STOPS),
            "stop": range(STOPS),
            "link": [NO_LINK, *range(STOPS - 1)],
        },
        "links": {"link": range(5), "from_stop": range(5), "to_stop": range(1, STOPS), "leg_m": 1113},
        "link_times": {
            "link": range(5),
            "hour": 5,
            "log_sigma": 1e-9,
            "mean_s": 100.0,
            "daytype": "weekday",
        },
        "demand": {
            "pattern": 0,
            "seq0": range(5),
            "hour": 5,
            "calls": 3,
            "board": 240.0,
            "daytype": "weekday",
        },
        "alighting": {
            "pattern": 0,
            "seq0": [*range(STOPS)] * 4,
            "period": np.repeat(range(4), STOPS),
            "p_alight": [float(stop in EMPTIES) for stop in range(STOPS)] * 4,
        },
        "trips": {
            "pattern": 0,
            "vehicle": range(3),
            "dep_s": np.array(DEPARTURES, int),
            "arr_s": np.array(DEPARTURES, int) + 500,
            "daytype": "weekday",
        },
    }
    tables = Tables(
        **{name: pd.DataFrame(frame) for name, frame in frames.items()},
        meta={"link_times_include_dwell": False},
    )
    network, lines = build(tables, config)
    return Prepared(config, network, lines, "hand-made")


class Visit(NamedTuple):
    """Visit of a bus at a stop."""

    arrived: float
    left: float
    boarded: int
    load: int


class Simulated(NamedTuple):
    """Result of the naive loop."""

    visits: dict[tuple[int, int], Visit]
    allowed: dict[tuple[int, int], tuple[bool, bool]]
    """By bus and stop of each decision: whether the bus might skip, and limit boarding at, the next stop."""
    wait: float
    left_behind: int


def simulate(arrivals: list[list[float]], plan: dict[tuple[int, int], int]) -> Simulated:
    """Drive one bus after the other; `plan`: actions by bus and stop, else 0."""
    result = Simulated({}, {}, 0.0, 0)
    skipped_last = [False] * STOPS
    total_wait, left_behind = 0.0, 0
    for bus, departure in enumerate(DEPARTURES):
        load, order, time = 0, 0, departure
        for stop in range(STOPS):
            arrived, boarded, action = time, 0, order
            order = 0
            alighting = load if stop in EMPTIES else 0
            load -= alighting
            if stop == STOPS - 1:
                result.visits[bus, stop] = Visit(arrived, math.nan, 0, 0)
                break
            queue, room = arrivals[stop], 1000
            if action in (SKIP, LIMIT):
                come = sum(arrival <= time for arrival in queue)
                room = 0 if action == SKIP else math.ceil(Fraction("0.4") * come)
            closed = action in (SKIP, LIMIT)
            held = False
            first = True
            while True:
                number = 0
                while queue and queue[0] <= time and number < room and load < 90:
                    total_wait += time - queue.pop(0)
                    number, load = number + 1, load + 1
                boarded += number
                if closed:
                    room = 0
                dwell = 3.0 * number
                if first and stop > 0:
                    dwell += 1.1 * alighting
                    dwell += 6.0 if dwell > 0 else 0.0
                elif first:
                    dwell = 0.0
                stands, first = first and stop > 0, False
                if dwell > 0 or stands:
                    time += dwell
                    continue
                if held or action == SKIP:
                    break
                held = True
                may_limit = stop + 1 < STOPS - 1
                may_skip = may_limit and not skipped_last[stop + 1]
                result.allowed[bus, stop] = (may_skip, may_limit)
                chosen = plan.get((bus, stop), 0)
                if (chosen == SKIP and may_skip) or (chosen == LIMIT and may_limit):
                    order = chosen
                time += 30.0 * chosen if chosen < SKIP else 0.0
            skipped_last[stop + 1] = order == SKIP
            left_behind += sum(arrival <= time for arrival in queue)
            result.visits[bus, stop] = Visit(arrived, time, boarded, load)
            time += 100.0
    return result._replace(wait=total_wait, left_behind=left_behind)


def test_a_hand_made_line_is_served_as_by_a_naive_loop() -> None:
    """Orders that are refused, because the bus before skips that stop or it is the last, are leaving at
    once; masks say so. Passengers alight where they want, also at a stop that is skipped."""
    plan = {
        **{(0, 0): SKIP, (0, 2): LIMIT, (0, 3): 2},
        **{(1, 0): SKIP, (1, 1): 3, (1, 2): SKIP, (1, 4): LIMIT},
        **{(2, 0): SKIP, (2, 2): LIMIT, (2, 3): LIMIT, (2, 4): SKIP},
    }
    prepared = hand_made()
    drawn = begun(BusBatchedEnv(prepared, 1), 5)
    arrivals = []
    for call in range(STOPS - 1):
        update_queue(prepared.network, prepared.settings[0], drawn.world, 0, call, 0, 21600.0)
        first, waiting = prepared.network.queue_first[call], drawn.world.queues["waiting"][0, call]
        arrivals.append(drawn.world.arrived_at[0, first : first + waiting].tolist())
    assert drawn.world.days["lost"][0] == 0
    expected = simulate(arrivals, plan)

    env = BusBatchedEnv(prepared, 1, traced=True)
    observed, allowed = env.reset(np.array([5], np.uint64)), {}
    # Each bus decides at one stop after the other; STOPS: at none any more.
    to_decide = [[*(stop for of, stop in expected.allowed if of == bus), STOPS] for bus in range(3)]
    for _ in range(prepared.config.ticks - 1):
        assert observed.action_masks is not None
        before, places = observed.action_masks[0].copy(), [stops[0] for stops in to_decide]
        assert before[:, :SKIP].all()
        outcome, observed = env.step(np.array([[plan.get(place, 0) for place in enumerate(places)]]))
        for bus in np.flatnonzero(outcome.acting[0]).tolist():
            allowed[bus, to_decide[bus].pop(0)] = (bool(before[bus, SKIP]), bool(before[bus, LIMIT]))
    assert allowed == expected.allowed
    trace, day = env.trace, env.world.days[0]
    for (bus, stop), visit in expected.visits.items():
        entry = trace.first[bus] + stop
        if stop > 0:
            assert trace.arrived[0, entry] == pytest.approx(visit.arrived)
        assert trace.left[0, entry] == pytest.approx(visit.left, nan_ok=True)
        assert trace.boarded[0, entry] == visit.boarded
        if stop < STOPS - 1:
            assert trace.load[0, entry] == visit.load
    assert (day["skipped"], day["limited"]) == (3, 3)
    assert day["denied"] == expected.left_behind
    assert day["wait"] == pytest.approx(expected.wait)
    # Everyone aboard alights at the stop that the second bus skips.
    assert expected.visits[1, 3].left > expected.visits[1, 3].arrived
    assert expected.visits[0, 1].left == expected.visits[0, 1].arrived


def test_a_boarding_limit_is_rounded_up_in_exact_arithmetic() -> None:
    """Floating-point rounding, as of 0.28 times 25 to above 7, lets no further passenger board."""
    env = begun(BusBatchedEnv(hand_made(), 1), 5)
    net, k, world = env.network, env.prepared.settings[0], env.world
    world.queues["next_arrival"] = np.inf
    world.leaves_at[:] = np.inf
    wrong = []
    for percent in range(1, 100):
        for waiting in range(1, 61):
            world.slots["load"][0, 0], world.queues["waiting"][0, 0] = 0, waiting
            if board(net, k, world, 0, 0, 18600.0, percent / 100) != -(-percent * waiting // 100):
                wrong.append((percent, waiting))
    assert not wrong


@pytest.mark.parametrize(
    ("action", "at", "control_every"),
    [(6, 3, 1), (SKIP, 2, 1), (0, 3, 2)],
    ids=["held at stop 3", "skips stop 3", "no control at stop 3"],
)
def test_masks_are_those_of_the_stop_at_which_a_bus_decides_next(
    action: int, at: int, control_every: int
) -> None:
    """A bus that stands at stop 3 and has no decision left there decides at stop 4 next, from where it may do
    neither, because stop 5 is the last. At stop 2 it may do both."""
    config = replace(hand_made().config, alighting_s=3.0, control_every=control_every)
    env = BusBatchedEnv(replace(hand_made(), config=config), 1)
    observed, masks = env.reset(np.array([5], np.uint64)), dict[int, NDArray[np.bool_]]()
    for _ in range(26):
        assert observed.action_masks is not None
        bus = env.world.slots[0, 0]
        if bus["phase"] == STANDING:  # of all control intervals at a stop the last counts
            masks[int(bus["call"])] = observed.action_masks[0, 0, SKIP:].copy()
        next_stop = int(bus["call"]) + (bus["phase"] == DRIVING)
        _, observed = env.step(np.full((1, 3), action if next_stop == at else 0))
    assert masks[2].all()
    assert not masks[3].any()


def test_two_buses_that_decide_at_a_terminal_before_either_leaves_do_not_both_skip_the_next_stop() -> None:
    """They leave after a delay. The first to leave passes the stop's queue, the second serves it."""
    noise = replace(hand_made().config.noise, dispatch_s=1200.0)
    config = replace(hand_made().config, noise=noise)
    env = BusBatchedEnv(replace(hand_made(), config=config), 1, traced=True)
    env.reset(np.array([5], np.uint64))
    while env.world.slots["phase"][0, 1] == DEPOT:
        env.step(np.array([[SKIP, SKIP, 0]]))
    assert env.world.slots["phase"][0, :2].tolist() == [DISPATCHED, DISPATCHED]
    assert env.world.slots["next_order"][0, :2].tolist() == [SKIP_NEXT, SKIP_NEXT]
    stop_1 = env.trace.first[:2] + 1
    while np.isnan(env.trace.left[0, stop_1]).any():
        env.step(np.zeros((1, 3), np.int64))
    boarded = env.trace.boarded[0, stop_1][np.argsort(env.trace.left[0, stop_1])]
    assert boarded[0] == 0
    assert boarded[1] > 0


def test_passengers_are_conserved_and_a_snapshot_continues_bit_for_bit() -> None:
    """Under random actions within the masks."""
    prepared = prepare(CONFIG)
    env, draw = BusBatchedEnv(prepared, 2), np.random.default_rng(2)
    assert env.spec.action_space == Discrete(9)
    observed, taken, rewards = env.reset(np.arange(2, dtype=np.uint64)), [], []
    saved = env.snapshot()
    for tick in range(600):
        if tick == 300:
            saved = env.snapshot()
        assert observed.action_masks is not None
        chances = observed.action_masks * np.array([3.0, *[0.2] * 6, 2.0, 2.0])
        taken.append((chances * draw.random(chances.shape)).argmax(axis=-1))
        outcome, observed = env.step(taken[-1])
        rewards.append(outcome.rewards.copy())
        if tick % 20 == 0:
            day, queues = env.world.days, env.world.queues
            assert np.all(day["boarded"] == day["alighted"] + env.world.slots["load"].sum(axis=1))
            assert np.all(day["arrived"] == day["boarded"] + queues["waiting"].sum(axis=1) + day["lost"])
            assert np.all(queues["denied"] <= queues["waiting"])
    assert env.world.days["skipped"].min() > 100
    assert env.world.days["limited"].min() > 100
    again = BusBatchedEnv(prepared, 2)
    again.restore(saved)
    for actions, paid in zip(taken[300:], rewards[300:], strict=True):
        np.testing.assert_array_equal(again.step(actions)[0].rewards, paid)


def test_a_rule_that_never_restricts_has_the_day_without_these_actions() -> None:
    days = []
    for config in (CONFIG, BusConfig(control="holding")):
        prepared = prepare(config)
        env = BusBatchedEnv(prepared, 3)
        observed = env.reset(child_seeds(17, "days", 0, 3))
        days.append(first_episodes(env, ENTRY.rules["two_way_headway"].make(prepared), observed))
    for name, values in days[1].items():
        np.testing.assert_array_equal(days[0][name], values, err_msg=name)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"control": "minute", "skipping": True}, "skipping"),
        ({"control": "minute", "boarding_limit": 0.5}, "boarding_limit"),
        ({"hold_levels": 0, "skipping": True}, "needs Discrete actions"),
        ({"hold_levels": 0, "boarding_limit": 0.5}, "needs Discrete actions"),
        ({"boarding_limit": 0.0}, "above 0 and at most 1"),
        ({"boarding_limit": 1.5}, "above 0 and at most 1"),
    ],
)
def test_settings_without_effect_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BusConfig(**{"control": "holding", **changed})

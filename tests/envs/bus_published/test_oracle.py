"""The kernel compared with a plain loop of the released dynamics, with one dictionary per bus."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import pytest

from headway_envs.bus.scenario.source import scenario_tables
from headway_envs.bus.scenario.tables import Tables
from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.env import BusPublishedBatchedEnv
from headway_envs.bus_published.kernel.layout import Network
from headway_envs.bus_published.network import recorded_median
from headway_envs.bus_published.prepared import Prepared, prepare

Begun = Callable[..., BusPublishedBatchedEnv]
Bus = dict[str, Any]
WEIGHTS = {"occupancy": 0.5, "uptime": 0.7, "regularity": 0.5, "efficiency": 0.6}


class Plain:
    """One copy as a plain loop."""

    def __init__(self, net: Network, routes: list[int], centre: int) -> None:
        self.net, self.centre = net, centre
        self.occupancy = net.occupancy.tolist()
        self.arrivals: dict[int, list[float]] = {}
        self.buses: list[Bus] = []
        for drawn in routes:
            first, last = net.route_first[drawn : drawn + 2]
            route = net.route_stop[first:last].tolist()
            self.buses.append(
                {
                    "clock": 21600.0, "driven": 0.0, "occupancy": float(int(self.occupancy[route[0]])),
                    "uptime": 1.0, "fuel": 100.0, "route": route, "place": 0, "stop": route[0], "way": 1,
                    "expected": sum(self.link(a, b) for a, b in pairwise(route)),
                }
            )  # fmt: skip

    def link(self, origin: int, target: int) -> float:
        return float(self.net.travel_s[origin, target])

    def reward(self, bus: Bus, stop: int) -> float:
        low, high, occupancy = 0.6, 0.9, bus["occupancy"]
        cost = 0.0
        if occupancy < low:
            cost = (low - occupancy) ** 2 / low**2
        elif occupancy > high:
            cost = (occupancy - high) ** 2 / (1.0 - high) ** 2
        times = self.arrivals[stop]
        intervals = [b - a for a, b in pairwise(times) if b - a > 0]
        regularity = 0.0
        if len(times) >= 3 and len(intervals) >= 2:
            mean_square = sum((gap - 600.0) ** 2 for gap in intervals) / len(intervals)
            regularity = 1.0 - min(math.sqrt(mean_square) / 600.0, 1.0)
        efficiency = min(max(1.0 - bus["driven"] / bus["expected"], 0.0), 1.0)
        total = (
            -WEIGHTS["occupancy"] * min(cost, 1.0)
            + WEIGHTS["uptime"] * bus["uptime"]
            + WEIGHTS["regularity"] * regularity
            + WEIGHTS["efficiency"] * efficiency
        )
        return total / sum(WEIGHTS.values())

    def spend(self, bus: Bus, seconds: float) -> None:
        bus["clock"] += seconds
        bus["uptime"] = max(bus["uptime"] - seconds / 43200.0, 0.0)
        bus["fuel"] = max(bus["fuel"] - seconds / 300.0, 0.0)

    def act(self, bus: Bus, action: int) -> float:
        route, here = bus["route"], bus["route"][bus["place"]]
        bus["stop"] = here
        if action == 0:
            self.spend(bus, 60.0)
            return -0.1
        if action == 2:
            seconds = 0.3 * float(self.net.detour_s[here, self.centre])
            if bus["fuel"] < seconds / 300.0:
                return -20.0
            bus["clock"] += seconds
            bus["driven"] += seconds
            bus["fuel"], bus["uptime"], bus["stop"] = 100.0, 1.0, self.centre
            return -(1.0 + seconds / 600.0)
        if not 0 <= bus["place"] + bus["way"] < len(route):
            bus["way"] = -bus["way"]
        bus["place"] += bus["way"]
        there = route[bus["place"]]
        bus["occupancy"] = min(max(0.5 * bus["occupancy"] + 0.5 * self.occupancy[here], 0.0), 1.0)
        self.spend(bus, self.link(here, there))
        bus["driven"] += self.link(here, there)
        bus["stop"] = there
        self.arrivals.setdefault(there, []).append(bus["clock"])
        return self.reward(bus, there)

    def seen(self, bus: Bus) -> list[float]:
        ahead = bus["place"] + 1
        following = bus["route"][ahead] if ahead < len(bus["route"]) else bus["stop"]
        mean = float(self.net.travel_s[0, 0])
        seconds = self.link(bus["stop"], following) if ahead < len(bus["route"]) else mean
        return [
            min(bus["clock"] / 86400.0, 1.0), bus["occupancy"], min(seconds / 3250.0, 1.0),
            float(self.net.demand[following]), bus["uptime"], 1.0, float(bus["stop"]), float(following),
        ]  # fmt: skip


@pytest.mark.parametrize("chances", [(0.3, 0.4, 0.3), (0.02, 0.96, 0.02), (0.0, 0.998, 0.002)])
def test_days_equal_those_of_a_plain_loop(begun: Begun, chances: tuple[float, float, float]) -> None:
    copies = 3
    env = begun(copies, observation="raw")
    observed = env.observed()
    plain = [
        Plain(env.network, env.world.buses[c]["route"].tolist(), int(env.world.days[c]["centre"]))
        for c in range(copies)
    ]
    rng = np.random.default_rng(5)
    totals, going = np.zeros(copies), np.ones(copies, bool)
    while going.any():
        actions = rng.choice(3, (copies, 5), p=chances)
        outcome, observed = env.step(actions)
        for c in np.flatnonzero(going):
            paid = [
                plain[c].act(bus, int(action)) for bus, action in zip(plain[c].buses, actions[c], strict=True)
            ]
            totals[c] += sum(paid)
            over = any(bus["clock"] >= 86400.0 for bus in plain[c].buses)
            shown = outcome.final_observations if over else observed.observations
            np.testing.assert_allclose(outcome.rewards[c], paid, rtol=1e-6, atol=1e-7)
            np.testing.assert_allclose(shown[c], [plain[c].seen(bus) for bus in plain[c].buses], rtol=1e-6)
            assert outcome.episode_ended[c] == over
            assert (outcome.terminated[c] == over).all()
            if over:
                going[c] = False
                assert outcome.metrics[c, 0] == pytest.approx(totals[c])


@pytest.mark.parametrize("centre", [None, 3])
def test_network_arrays_have_the_layout_of_workers_copies(centre: int | None) -> None:
    """They must be writable and C-contiguous as in workers, otherwise numba compiles the kernel again."""
    network = prepare(BusPublishedConfig(scenario="line", centre=centre)).network
    for name, array in network._asdict().items():
        assert array.flags.writeable, name
        assert array.flags.c_contiguous, name


def test_a_links_time_is_the_median_of_the_times_that_the_released_code_keeps(line: Prepared) -> None:
    """Times are drawn as the scenario describes them, and filtered one by one as in the released script."""
    net, (_, links, times) = line.network, _line_tables()
    rng, compared = np.random.default_rng(3), 0
    for link in links[:: len(links) // 12]:
        hours = [row for row in times if row.link == link.link]
        drawn: list[float] = []
        for row in hours:
            centre = math.log(row.mean_s) - row.log_sigma**2 / 2
            drawn += np.exp(rng.normal(centre, row.log_sigma, 20_000)).tolist()
        kept = [second for second in drawn if 120.0 <= second <= 1800.0]
        if len(kept) < 1000:
            continue  # too few to compare with
        lower, upper = np.percentile(kept, [25, 75])
        low, high = lower - 1.5 * (upper - lower), upper + 1.5 * (upper - lower)
        expected = np.median([second for second in kept if low <= second <= high])
        compared += 1
        assert net.travel_s[link.from_stop, link.to_stop] == pytest.approx(expected, rel=0.02)
    assert compared >= 6


def test_a_link_without_kept_times_takes_the_mean_of_the_others() -> None:
    """A median below which every time of a year lies is none."""
    rows = {"link": [0, 0, 1, 2], "hour": [7, 8, 7, 7], "mean_s": [20.0, 20.0, 60.0, 300.0]}
    times = pd.DataFrame({**rows, "log_sigma": 0.2})
    found = recorded_median(times, pd.Series({0: 100.0, 1: 100.0, 2: 100.0}))
    assert math.isnan(found[0])
    assert 120.0 < found[1] < 135.0  # only its slowest times are kept
    assert found[2] == pytest.approx(300.0 * math.exp(-0.02), rel=0.01)
    assert recorded_median(times, pd.Series({2: 100.0})).isna().tolist() == [True, True, False]


def test_the_network_follows_the_tables(line: Prepared) -> None:
    """Loads of leaving buses over 80 places, demand, and shortest paths by another algorithm."""
    net, (tables, links, _) = line.network, _line_tables()
    stops = sorted(tables.stops["stop"])
    seconds = {(row.from_stop, row.to_stop): net.travel_s[row.from_stop, row.to_stop] for row in links}
    mean = np.mean(list(seconds.values()))
    for route in range(2):
        calls = net.route_stop[net.route_first[route] : net.route_first[route + 1]].tolist()
        rows = tables.pattern_stops[tables.pattern_stops["pattern"] == route].sort_values("seq0")
        assert [stops[call] for call in calls] == rows["stop"].tolist()
        assert net.expected_s[route] == pytest.approx(sum(seconds[pair] for pair in pairwise(calls)))
        assert net.travel_s[calls[1], calls[0]] == pytest.approx(mean)  # the table knows only the way out
    for stop in range(0, len(stops), 7):
        occupancy, boardings = _on_board(tables, stops[stop])
        assert net.occupancy[stop] == pytest.approx(min(occupancy, 1.0))
        assert net.demand[stop] == pytest.approx(min(boardings, 150.0))
    places = tables.stops.set_index("stop").loc[stops]
    north = places["lat"].to_numpy() * 111_320.0
    east = places["lon"].to_numpy() * 111_320.0 * np.cos(np.radians(places["lat"].mean()))
    ways: dict[int, dict[int, float]] = {a: {} for a in range(len(stops))}
    for a in ways:
        for b in ways:
            apart = math.hypot(north[a] - north[b], east[a] - east[b])
            found = [seconds[a, b]] if (a, b) in seconds else []
            if not found:
                found = [mean] * ((b, a) in seconds) + [apart * 3.6 / 20.0] * (a != b and apart <= 60.0)
            if found:
                ways[a][b] = min(found)
    for stop in range(0, len(stops), 7):
        np.testing.assert_allclose(net.detour_s[stop], _shortest(ways, stop), rtol=1e-9)
    assert np.isfinite(net.detour_s).all()


def _line_tables() -> tuple[Tables, list[Any], list[Any]]:
    """Return the tables of the line, the rows of its links, between stops by their row, and of their weekday
    times."""
    tables = scenario_tables("line", 0)
    row_of = {stop: row for row, stop in enumerate(sorted(tables.stops["stop"]))}
    links = tables.links.replace({"from_stop": row_of, "to_stop": row_of})
    times = [row for row in tables.link_times.itertuples() if row.daytype == "weekday"]
    return tables, list(links.itertuples()), times


def _on_board(tables: Tables, stop: int) -> tuple[float, float]:
    """Return the weekday occupancy, of 80 places, of buses leaving a stop, and its boardings."""
    boards: dict[tuple[int, int], list[float]] = {}
    for row in tables.demand.itertuples():
        if row.daytype == "weekday":
            period = (row.hour >= 9) + (row.hour >= 15) + (row.hour >= 20)
            boards.setdefault((row.pattern, row.seq0), [0.0] * 4)[period] += row.board
    leaves = {(row.pattern, row.seq0, row.period): row.p_alight for row in tables.alighting.itertuples()}
    load = buses = boardings = 0.0
    last = tables.pattern_stops.groupby("pattern")["seq0"].max()
    for call in tables.pattern_stops[tables.pattern_stops["stop"] == stop].itertuples():
        for period in range(4):
            on_board = 0.0
            for seq0 in range(call.seq0 + 1 if call.seq0 < last[call.pattern] else 0):
                on_board *= 1.0 - leaves.get((call.pattern, seq0, period), 0.0)
                on_board += boards.get((call.pattern, seq0), [0.0] * 4)[period]
            load += on_board
        trips = tables.trips[tables.trips["pattern"] == call.pattern]
        buses += (trips["daytype"] == "weekday").sum()
        boardings += sum(boards.get((call.pattern, call.seq0), []))
    return load / buses / 80.0, boardings


def _shortest(ways: dict[int, dict[int, float]], origin: int) -> list[float]:
    """Return the shortest times from a stop to every stop, by relaxing links until nothing changes."""
    time = dict.fromkeys(ways, math.inf) | {origin: 0.0}
    open_stops = [origin]
    while open_stops:
        here = open_stops.pop(0)
        for there, seconds in ways[here].items():
            if time[here] + seconds < time[there]:
                time[there] = time[here] + seconds
                open_stops.append(there)
    return [time[stop] for stop in ways]

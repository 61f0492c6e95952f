"""Network of the published bus environment, built from the tables of a bus scenario."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.measures import METRES_PER_DEGREE, link_loads
from headway_envs.bus.scenario.tables import Tables
from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.kernel.layout import CAPACITY, Network

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CROSSING_M = 60.0
"""Largest distance at which two stops count as joined on the way to a centre, m: the two sides of a road, or
bays of a terminal. Lines of `line` and `corridor` share no stop."""
CROSSING_MPS = 20.0 / 3.6
"""Speed between joined stops, m/s."""


def build(tables: Tables, config: BusPublishedConfig) -> tuple[Network, tuple[str, ...]]:
    """Return the network and the line of each route.

    Routes are patterns in the order of their numbers: first the first pattern of each line; if there are more
    routes than lines, then the second pattern of each line, and so on.

    Raises HeadwayError for too few patterns, or for a centre that does not exist or cannot be reached.
    """
    patterns = tables.patterns.sort_values("pattern")
    rank = patterns.groupby("line", sort=False).cumcount()
    patterns = patterns.assign(rank=rank).sort_values(["rank", "pattern"]).head(config.routes)
    if len(patterns) < config.routes:
        raise HeadwayError(
            f"agents {config.agents} with agents_per_route {config.agents_per_route} need {config.routes} "
            f"routes, and scenario '{config.scenario}' has {len(patterns)}: set agents_per_route higher"
        )
    stops = tables.stops["stop"].sort_values().to_numpy()
    row_of = pd.Series(np.arange(len(stops)), index=stops)
    routes = [_route(tables, pattern, row_of) for pattern in patterns["pattern"]]
    call_stop = np.array(list(dict.fromkeys(np.concatenate(routes).tolist())), np.int64)
    call_of = {stop: call for call, stop in enumerate(call_stop.tolist())}
    links, mean_s = _links(tables, config.day_type, row_of)
    travel = np.full((len(stops), len(call_stop)), mean_s)
    for origin, target, seconds in links.itertuples(index=False):
        if target in call_of:
            travel[origin, call_of[target]] = seconds
    route_call = [np.array([call_of[stop] for stop in route.tolist()], np.int64) for route in routes]
    detour = _detours(tables, links, mean_s, row_of, call_stop)
    occupancy, demand = _passengers(tables, config.day_type, row_of)
    network = Network(
        route_first=np.concatenate(([0], np.cumsum([len(route) for route in routes]))).astype(np.int64),
        route_call=np.concatenate(route_call),
        expected_s=np.array(
            [travel[call_stop[calls[:-1]], calls[1:]].sum() for calls in route_call], np.float64
        ),
        call_stop=call_stop,
        travel_s=travel,
        detour_s=detour,
        occupancy=occupancy[call_stop],
        demand=demand,
        centres=_centres(detour, config),
    )
    return network, tuple(str(line) for line in patterns["line"])


def _route(tables: Tables, pattern: int, row_of: "pd.Series[int]") -> Integers:
    """Return the rows of a pattern's stops, in order."""
    calls = tables.pattern_stops[tables.pattern_stops["pattern"] == pattern].sort_values("seq0")
    return np.asarray(row_of.loc[calls["stop"]], np.int64)


def _links(tables: Tables, day: str, row_of: "pd.Series[int]") -> tuple[pd.DataFrame, float]:
    """Return the links as rows of stops with their mean times, s, and the mean over all links.

    Times are means over the hours of the day.
    """
    times = tables.link_times[tables.link_times["daytype"] == day].groupby("link")["mean_s"].mean()
    if times.empty:
        raise HeadwayError(f"table link_times has no rows of day_type {day}: choose the other day_type")
    links = tables.links[tables.links["link"].isin(times.index)]
    seconds = pd.Series(
        times.loc[links["link"]].to_numpy(np.float64),
        index=pd.MultiIndex.from_arrays(
            [row_of.loc[links["from_stop"]], row_of.loc[links["to_stop"]]], names=["origin", "target"]
        ),
        name="seconds",
    )
    frame = seconds.groupby(level=[0, 1]).mean().reset_index()
    return frame, float(frame["seconds"].mean())


def _detours(
    tables: Tables, links: pd.DataFrame, mean_s: float, row_of: "pd.Series[int]", call_stop: Integers
) -> Floats:
    """Return shortest-path times (K, S), s.

    Links can be driven both ways; a direction that the table lacks takes the mean time of all links, as
    everywhere in the released code.
    """
    count = len(row_of)
    known = set(zip(links["origin"], links["target"], strict=True))
    ways = [links.to_numpy(np.float64)]
    lacking = [(b, a, mean_s) for a, b in known if (b, a) not in known]
    joined = [(a, b, seconds) for a, b, seconds in _crossings(tables, row_of) if (a, b) not in known]
    ways += [np.array(more, np.float64).reshape(-1, 3) for more in (lacking, joined)]
    # A sparse matrix would add the times of two links between the same stops, and drop links of time 0.
    every = pd.DataFrame(np.concatenate(ways)).groupby([0, 1], as_index=False)[2].min()
    seconds = np.maximum(every[2].to_numpy(np.float64), 1e-3)
    graph = coo_matrix((seconds, (every[0].astype(int), every[1].astype(int))), shape=(count, count))
    return np.ascontiguousarray(dijkstra(graph.tocsr(), indices=call_stop), np.float64)


def _crossings(tables: Tables, row_of: "pd.Series[int]") -> list[tuple[int, int, float]]:
    """Return the pairs of stops within CROSSING_M, in both directions, with the time between them, s."""
    places = tables.stops.set_index("stop").loc[row_of.index]
    latitude = places["lat"].to_numpy(np.float64)
    east = places["lon"].to_numpy(np.float64) * np.cos(np.radians(latitude.mean())) * METRES_PER_DEGREE
    points = np.column_stack((east, latitude * METRES_PER_DEGREE))
    found = []
    for a, b in KDTree(points).query_pairs(CROSSING_M):
        seconds = float(np.hypot(*(points[a] - points[b]))) / CROSSING_MPS
        found += [(int(a), int(b), seconds), (int(b), int(a), seconds)]
    return found


def _passengers(tables: Tables, day: str, row_of: "pd.Series[int]") -> tuple[Floats, Floats]:
    """Return mean occupancies (S,) of buses on the way to each stop, and boardings per day (S,).

    Occupancies are relative to CAPACITY.
    """
    loads = link_loads(tables, day)
    departures = tables.trips[tables.trips["daytype"] == day].groupby("pattern").size()
    loads["buses"] = departures.reindex(loads["pattern"]).fillna(0.0).to_numpy(np.float64)
    of_stop = loads.groupby("stop")[["load", "buses"]].sum().reindex(row_of.index).fillna(0.0)
    occupancy = (of_stop["load"] / of_stop["buses"].where(of_stop["buses"] > 0)).fillna(0.0) / CAPACITY
    board = tables.demand[tables.demand["daytype"] == day].groupby(["pattern", "seq0"])["board"].sum()
    stop_of = loads.set_index(["pattern", "seq0"])["stop"].reindex(board.index)
    demand = board.groupby(stop_of.to_numpy()).sum().reindex(row_of.index).fillna(0.0)
    # Copies, because pandas returns read-only views, for which numba would compile the kernel again.
    return occupancy.to_numpy(np.float64, copy=True), demand.to_numpy(np.float64, copy=True)


def _centres(detour: Floats, config: BusPublishedConfig) -> Integers:
    """Return the rows of the stops that can be the centre.

    They are the configured one, else all stops that can be reached from every call.
    """
    reached = np.flatnonzero(np.isfinite(detour).all(axis=0)).astype(np.int64)
    if config.centre is None:
        if not len(reached):
            raise HeadwayError(
                f"scenario '{config.scenario}' has no stop that all routes can reach: choose another"
            )
        return reached
    if config.centre not in reached:
        raise HeadwayError(
            f"centre {config.centre} is none of the {detour.shape[1]} stops of scenario '{config.scenario}', "
            f"or not all routes reach it: choose one such as {reached[0] if len(reached) else 'another'}"
        )
    return np.array([config.centre], np.int64)

"""Network of the published bus environment, built from the tables of a bus scenario."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree
from scipy.special import ndtr

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


SHORTEST_S, LONGEST_S = 120.0, 1800.0
"""Range of the recorded link times that the released code keeps, s."""
TIME_STEP_S = 5.0
"""Step of the grid on which the distribution of a link's times is computed, s."""
RECORDED_DAYS = 365
"""Days of records behind the released tables. A link with fewer than one kept time in them has no time."""
MOST_DEMAND = 150.0
"""Largest demand at a stop, boardings per day, as in the released code."""


def build(tables: Tables, config: BusPublishedConfig) -> Network:
    """Return the network. Routes are the patterns with trips on the day type, by their numbers.

    Raises HeadwayError for a day type without trips, or a centre that does not exist or cannot be reached.
    """
    trips = tables.trips[tables.trips["daytype"] == config.day_type].groupby("pattern").size()
    if trips.empty:
        raise HeadwayError(
            f"scenario '{config.scenario}' has no trips of day_type {config.day_type}: choose another"
        )
    stops = tables.stops["stop"].sort_values().to_numpy()
    row_of = pd.Series(np.arange(len(stops)), index=stops)
    routes = [_route(tables, pattern, row_of) for pattern in trips.index]
    links, mean_s = _links(tables, trips, config.day_type, row_of)
    travel = np.full((len(stops), len(stops)), mean_s)
    travel[links["origin"].to_numpy(), links["target"].to_numpy()] = links["seconds"]
    detour = _detours(tables, links, mean_s, row_of)
    occupancy, demand = _passengers(tables, trips, config.day_type, row_of)
    return Network(
        route_first=np.concatenate(([0], np.cumsum([len(route) for route in routes]))).astype(np.int64),
        route_stop=np.concatenate(routes),
        route_share=np.cumsum(trips.to_numpy(np.float64)) / trips.sum(),
        expected_s=np.array([travel[route[:-1], route[1:]].sum() for route in routes], np.float64),
        travel_s=travel,
        detour_s=detour,
        occupancy=occupancy,
        demand=demand,
        centres=_centres(detour[np.unique(np.concatenate(routes))], config),
    )


def _route(tables: Tables, pattern: int, row_of: "pd.Series[int]") -> Integers:
    """Return the rows of a pattern's stops, in order."""
    calls = tables.pattern_stops[tables.pattern_stops["pattern"] == pattern].sort_values("seq0")
    return np.asarray(row_of.loc[calls["stop"]], np.int64)


def _links(
    tables: Tables, trips: "pd.Series[int]", day: str, row_of: "pd.Series[int]"
) -> tuple[pd.DataFrame, float]:
    """Return the links as rows of stops with their times, s, and the mean over all links.

    `trips`: number of trips per day by pattern. A link whose times are never recorded takes the mean.
    """
    times = tables.link_times[tables.link_times["daytype"] == day]
    if times.empty:
        raise HeadwayError(f"table link_times has no rows of day_type {day}: choose the other day_type")
    passes = tables.pattern_stops.assign(trips=tables.pattern_stops["pattern"].map(trips).fillna(0.0))
    median = recorded_median(times, passes.groupby("link")["trips"].sum())
    links = tables.links[tables.links["link"].isin(median.index)]
    seconds = pd.Series(
        median.loc[links["link"]].to_numpy(np.float64),
        index=pd.MultiIndex.from_arrays(
            [row_of.loc[links["from_stop"]], row_of.loc[links["to_stop"]]], names=["origin", "target"]
        ),
        name="seconds",
    )
    frame = seconds.groupby(level=[0, 1]).mean().reset_index()
    mean_s = float(frame["seconds"].mean()) if frame["seconds"].notna().any() else SHORTEST_S
    return frame.fillna({"seconds": mean_s}), mean_s


def recorded_median(times: pd.DataFrame, trips: "pd.Series[float]") -> "pd.Series[float]":
    """Return the time of each link that the released code takes from records, s; NaN where it finds none.

    It keeps times between SHORTEST_S and LONGEST_S, of these the ones within 1.5 interquartile ranges of the
    quartiles, and takes their median. The records are not public: here a time is lognormal in each hour of
    `times` (a table link_times of one day type), and the hours weigh the same. `trips`: number per day by
    link.
    """
    grid = np.arange(SHORTEST_S, LONGEST_S + TIME_STEP_S, TIME_STEP_S)
    link, row = np.unique(times["link"], return_inverse=True)
    below = np.zeros((len(link), len(grid)))
    sigma = np.maximum(times["log_sigma"].to_numpy(np.float64), 1e-6)
    centre = np.log(times["mean_s"].to_numpy(np.float64)) - 0.5 * sigma**2
    for hour in np.unique(times["hour"]):
        of_hour = np.flatnonzero(times["hour"] == hour)
        deviation = (np.log(grid) - centre[of_hour, None]) / sigma[of_hour, None]
        np.add.at(below, row[of_hour], ndtr(deviation))
    below /= np.bincount(row)[:, None]
    median = np.full(len(link), np.nan)
    passing = trips.reindex(link).fillna(0.0).to_numpy(np.float64)
    kept = (below[:, -1] - below[:, 0]) * passing * RECORDED_DAYS
    for n in np.flatnonzero(kept >= 1.0):
        rising = np.concatenate(([True], np.diff(below[n]) > 0))
        share, seconds = below[n][rising], grid[rising]
        first, last = share[0], share[-1]
        low, high = np.interp(first + np.array([0.25, 0.75]) * (last - first), share, seconds)
        ends = np.array([low, high]) + 1.5 * (high - low) * np.array([-1.0, 1.0])
        median[n] = np.interp(np.interp(ends, seconds, share).mean(), share, seconds)
    return pd.Series(median, index=link)


def _detours(tables: Tables, links: pd.DataFrame, mean_s: float, row_of: "pd.Series[int]") -> Floats:
    """Return shortest-path times (S, S), s.

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
    return np.ascontiguousarray(dijkstra(graph.tocsr()), np.float64)


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


def _passengers(
    tables: Tables, trips: "pd.Series[int]", day: str, row_of: "pd.Series[int]"
) -> tuple[Floats, Floats]:
    """Return mean occupancies (S,) of buses that leave each stop, and boardings per day (S,).

    Occupancies are relative to CAPACITY, at most 1, and NaN at stops without buses. `trips`: number per day
    by pattern.
    """
    loads = link_loads(tables, day)
    # The load of the link to the next call; everyone has left at the last call.
    loads["load"] = loads.groupby("pattern")["load"].shift(-1).fillna(0.0)
    loads["buses"] = trips.reindex(loads["pattern"]).fillna(0.0).to_numpy(np.float64)
    of_stop = loads.groupby("stop")[["load", "buses"]].sum().reindex(row_of.index)
    occupancy = (of_stop["load"] / of_stop["buses"].where(of_stop["buses"] > 0)) / CAPACITY
    board = tables.demand[tables.demand["daytype"] == day].groupby(["pattern", "seq0"])["board"].sum()
    stop_of = loads.set_index(["pattern", "seq0"])["stop"].reindex(board.index)
    demand = board.groupby(stop_of.to_numpy()).sum().reindex(row_of.index).fillna(0.0)
    # Copies, because pandas returns read-only views, for which numba would compile the kernel again.
    return (
        occupancy.clip(upper=1.0).to_numpy(np.float64, copy=True),
        demand.clip(upper=MOST_DEMAND).to_numpy(np.float64, copy=True),
    )


def _centres(detour: Floats, config: BusPublishedConfig) -> Integers:
    """Return the rows of the stops that can be the centre.

    They are the configured one, else all stops that can be reached from every stop of a route. `detour`: rows
    of the shortest-path times (S, S) from those stops.
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

"""Vehicles for a timetable without blocks: each trip begins where its vehicle's last one ended."""

import heapq

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway_envs.bus.scenario.measures import METRES_PER_DEGREE

MIN_LAYOVER_S = 300.0
"""Minimum layover between two trips of a vehicle, s. In SUNT, 97.9% of vehicles continue where they arrived,
after a median of 286 s."""
TERMINAL_M = 300.0
"""Largest distance between two stops of a terminal, m."""


def terminals(stops: pd.DataFrame, ends: NDArray[np.int64]) -> dict[int, int]:
    """Return the number of the terminal of each stop in `ends` (rows of the frame with lat, lon)."""
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    ends = np.unique(ends)
    lat, lon = stops["lat"].to_numpy(np.float64)[ends], stops["lon"].to_numpy(np.float64)[ends]
    places = np.column_stack((lat, lon * np.cos(np.radians(lat.mean())))) * METRES_PER_DEGREE
    near = KDTree(places).query_pairs(TERMINAL_M, output_type="ndarray")
    joined = coo_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=(len(ends),) * 2)
    # Connected stops may stretch over kilometres, so each component is split into terminals.
    count, row = connected_components(joined, directed=False)
    terminal = np.zeros(len(ends), np.int64)
    found = 0
    for members in np.split(
        np.argsort(row, kind="stable"), np.cumsum(np.bincount(row, minlength=count))[:-1]
    ):
        if len(members) > 1:
            tree = linkage(places[members], method="complete")
            terminal[members] = found + fcluster(tree, TERMINAL_M, criterion="distance") - 1
        else:
            terminal[members] = found
        found = int(terminal[members].max()) + 1
    return dict(zip(ends.tolist(), terminal.tolist(), strict=True))


def chain_at_terminals(trips: pd.DataFrame) -> NDArray[np.int64]:
    """Return the vehicle number of each trip (J,), given its dep_s, arr_s and terminals `begin` and `end`.

    Trips are assigned in order of departure. Each gets the vehicle that has waited longest at its first
    terminal, or a new one if none is ready there.
    """
    waiting: dict[int, list[tuple[float, int]]] = {}
    vehicle = np.zeros(len(trips), np.int64)
    count = 0
    departs, arrives = trips["dep_s"].to_numpy(np.float64), trips["arr_s"].to_numpy(np.float64)
    first, last = trips["begin"].to_numpy(), trips["end"].to_numpy()
    for trip in np.lexsort((first, departs)):
        there = waiting.get(int(first[trip]), [])
        if there and there[0][0] <= departs[trip]:
            vehicle[trip] = heapq.heappop(there)[1]
        else:
            vehicle[trip] = count
            count += 1
        ready = (float(arrives[trip]) + MIN_LAYOVER_S, int(vehicle[trip]))
        heapq.heappush(waiting.setdefault(int(last[trip]), []), ready)
    return vehicle

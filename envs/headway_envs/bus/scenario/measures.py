"""Measures used in several places: distances, hours of travel times, loads of links."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.scenario.tables import PERIOD_HOURS, Tables

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

METRES_PER_DEGREE = 111_320.0
"""Length of a degree of latitude, and of a degree of longitude at the equator, m."""
MAX_SPEED_MPS = 25.0
"""Largest plausible mean speed between stops, m/s: 90 km/h."""
TIMED_HOURS = np.arange(4, 27)
"""Hours for which link times are written. Earlier and later drives take the nearest of them."""


def distance_m(lat: Floats, lon: Floats, lat2: Floats, lon2: Floats) -> Floats:
    """Return the straight-line distance by the local flat approximation at `lat`, m."""
    north = (lat2 - lat) * METRES_PER_DEGREE
    east = (lon2 - lon) * METRES_PER_DEGREE * np.cos(np.radians(lat))
    return np.asarray(np.hypot(north, east), dtype=np.float64)


def metres_along(tables: Tables) -> "pd.Series[float]":
    """Return each call's distance along the links from the first call, m, indexed by pattern and seq0."""
    import pandas as pd

    calls = tables.pattern_stops.sort_values(["pattern", "seq0"])
    metres = tables.links.set_index("link")["leg_m"].astype(np.float64).reindex(calls["link"])
    legs = pd.Series(metres.to_numpy(), index=pd.MultiIndex.from_frame(calls[["pattern", "seq0"]]))
    legs[calls["seq0"].to_numpy() == 0] = 0.0
    return legs.groupby("pattern").cumsum()


def link_loads(tables: Tables, day: str) -> "pd.DataFrame":
    """Return one row per call (pattern, seq0, stop, link) with `load`, passengers per day on the link.

    Boardings and alightings follow the tables, as if no bus were ever full.
    """
    import pandas as pd

    demand = tables.demand[tables.demand["daytype"] == day]
    period = np.searchsorted(PERIOD_HOURS, demand["hour"], side="right")
    boards = demand.assign(period=period).groupby(["pattern", "seq0", "period"])["board"].sum()
    alights = tables.alighting.set_index(["pattern", "seq0", "period"])["p_alight"]
    calls = tables.pattern_stops.sort_values(["pattern", "seq0"]).reset_index(drop=True)
    load = np.zeros(len(calls))
    on_board = np.zeros(4)
    keys = [pd.MultiIndex.from_frame(calls[["pattern", "seq0"]].assign(period=p)) for p in range(4)]
    boarding = np.column_stack([boards.reindex(key).fillna(0.0).to_numpy(np.float64) for key in keys])
    alighting = np.column_stack([alights.reindex(key).fillna(0.0).to_numpy(np.float64) for key in keys])
    for call, seq0 in enumerate(calls["seq0"].to_numpy()):
        if seq0 == 0:
            on_board = np.zeros(4)
        load[call] = on_board.sum()
        on_board = on_board * (1.0 - alighting[call]) + boarding[call]
    return calls.assign(load=load)

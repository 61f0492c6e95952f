"""Link times of SUNT, from its trip records."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway_envs.bus.scenario.link_times import plausible_drives, smoothed_link_times
from headway_envs.bus.scenario.sunt.records import Day


def link_times(
    network: Mapping[str, pd.DataFrame], days: Sequence[Day], counted: Counter[str]
) -> pd.DataFrame:
    """Return the table link_times for the day types of `days`."""
    links = network["links"]
    stop_id = network["stops"].set_index("stop")["stop_id"]
    ends = pd.MultiIndex.from_arrays(
        [stop_id.reindex(links["from_stop"]).to_numpy(), stop_id.reindex(links["to_stop"]).to_numpy()]
    )
    metres = links["leg_m"].to_numpy(np.float64)
    frames = []
    for kind in ("weekday", "sunday"):
        own = [day.calls for day in days if day.day_type == kind]
        if own:
            legs = pd.concat([_drives(calls, ends, metres, counted) for calls in own], ignore_index=True)
            frames.append(smoothed_link_times(legs, metres, counted).assign(daytype=kind))
    return pd.concat(frames, ignore_index=True)


def _drives(
    calls: pd.DataFrame, ends: pd.MultiIndex, metres: NDArray[np.float64], counted: Counter[str]
) -> pd.DataFrame:
    """Return link, hour and duration (s) of each plausible drive from one stop to the next."""
    stop, time = calls["stop_id"].to_numpy(), calls["time"].to_numpy()
    following = (np.diff(calls["trip"]) == 0) & (np.diff(calls["seq"]) == 1)
    pairs = pd.MultiIndex.from_arrays([stop[:-1][following], stop[1:][following]])
    link = ends.get_indexer(pairs)
    legs = pd.DataFrame({"link": link, "hour": time[:-1][following] // 3600, "s": np.diff(time)[following]})
    return plausible_drives(legs[legs["link"] >= 0], metres, counted)

"""Plots of days: buses in time and space, loads along a pattern, headways along the route."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from headway_envs.bus.realism.trip_statistics import FIFTHS, cv_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection


def plot_time_space(
    axes: "Axes",
    calls: pd.DataFrame,
    pattern: int,
    km: "pd.Series[float]",
    hours: tuple[float, float],
    fullest: float = 75.0,
) -> "LineCollection":
    """Plot one line per bus of the pattern, over time and km from the first call; return the lines.

    Lines are coloured by load (up to `fullest`) and horizontal where the bus stands; they are returned for a
    colour bar. `calls`: those of one day; `km`: by pattern and seq0; `hours`: limits of the time axis.
    """
    from matplotlib.collections import LineCollection

    own = calls[calls["pattern"] == pattern].sort_values(["trip", "seq0"])
    place = km.reindex(pd.MultiIndex.from_frame(own[["pattern", "seq0"]])).to_numpy()
    came = own["time"].to_numpy(np.float64) / 3600.0
    left = own["left"].to_numpy(np.float64) / 3600.0
    load = own["load"].to_numpy(np.float64)
    follows = np.append(np.diff(own["trip"].to_numpy()) == 0, False)
    stand = np.flatnonzero(~np.isnan(left))
    drive = np.flatnonzero(follows & ~np.isnan(left))
    at_stop = np.stack([np.stack([came, place], 1)[stand], np.stack([left, place], 1)[stand]], axis=1)
    on_way = np.stack([np.stack([left, place], 1)[drive], np.stack([came, place], 1)[drive + 1]], axis=1)
    lines = LineCollection(list(np.concatenate((at_stop, on_way))), cmap="viridis_r", linewidths=1.4)
    lines.set_array(np.concatenate((load[stand], load[drive])))
    lines.set_clim(0.0, fullest)
    axes.add_collection(lines)
    axes.set_xlim(*hours)
    axes.set_ylim(0.0, float(np.nanmax(place)) if len(place) else 1.0)
    axes.set_xlabel("hour of the day")
    axes.set_ylabel("km from the first stop")
    axes.label_outer()
    return lines


def plot_load_profile(
    axes: "Axes", days: Mapping[str, pd.DataFrame], pattern: int, expected: "pd.Series[float] | None" = None
) -> None:
    """Plot the mean number of passengers aboard at departure, by call of a pattern.

    One line per entry of `days` (name -> calls), and for the first also the band from the 10th to the 90th
    percentile. `expected`, indexed by `seq0`, is dashed.
    """
    for number, (name, calls) in enumerate(days.items()):
        loads = calls[calls["pattern"] == pattern].groupby("seq0")["load"]
        mean = loads.mean().dropna()
        axes.plot(mean.index, mean.to_numpy(), color=f"C{number}", label=name)
        if number == 0:
            low, high = loads.quantile(0.1).loc[mean.index], loads.quantile(0.9).loc[mean.index]
            axes.fill_between(
                mean.index, low.to_numpy(), high.to_numpy(), color="C0", alpha=0.2, linewidth=0, label="80%"
            )
    if expected is not None:
        axes.plot(
            expected.index,
            expected.to_numpy(),
            color="black",
            linestyle="--",
            label="expected from the tables",
        )
    axes.set_ylim(bottom=0)
    axes.set_xlabel("call")
    axes.set_ylabel("passengers aboard")
    axes.legend()


def plot_headways_along(axes: "Axes", statistics: Mapping[str, Mapping[str, float]]) -> None:
    """Plot the headway CV by fifth of the route, one line per entry of `statistics`.

    `statistics`: label -> statistic -> value. Fifths without a value are left out.
    """
    fifths = list(range(1, FIFTHS + 1))
    for name, values in statistics.items():
        there = [fifth for fifth in fifths if cv_name(fifth - 1) in values]
        cvs = [values[cv_name(fifth - 1)] for fifth in there]
        if there:
            axes.plot(there, cvs, marker="o", label=name, color="black" if name == "measured" else None)
    axes.set_xticks(fifths)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("fifth of the route")
    axes.set_ylabel("headway CV, within two hours")
    axes.legend()

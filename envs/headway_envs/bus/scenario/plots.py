"""Plot of a scenario: map of the lines with the loads of links, and buses, boardings and headways by hour."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.description import buses_at_once, clock
from headway_envs.bus.scenario.measures import METRES_PER_DEGREE, link_loads
from headway_envs.bus.scenario.tables import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

_MIN_ASPECT = 0.4
"""Smallest ratio of the map's shorter side to its longer side."""
_MAX_LINK_WIDTH = 7.0
"""Width of the link with the largest load, points."""
_LINE_COLOURS = 10
"""Number of lines up to which each has its own colour. If there are more, lines are coloured by headway."""
_TICKS_H = (0.25, 0.5, 1.0, 3.0, 6.0)
"""Distances between the numbers of the time axis, h."""
_MOST_TICKS = 8
"""Number of these distances along the axis, at most."""
_HEADWAYS_MIN = (5.0, 60.0)
"""Ends of the colour scale of headways, minutes."""


def plot_scenario(tables: Tables, day: str, title: str) -> "Figure":
    """Return a plot of one day type. Raises HeadwayError if the day type has no trips.

    Left: a map with links as wide as their number of passengers per day, coloured by line for up to ten
    lines, else by the headway of their buses. Right, by hour: buses on the road, boardings, and headways of
    patterns.
    """
    from matplotlib.figure import Figure

    trips = tables.trips[tables.trips["daytype"] == day]
    if trips.empty:
        raise HeadwayError(f"--day-type: there is no trip on a {day}; choose the other day type")
    from matplotlib.ticker import MultipleLocator

    figure = Figure(figsize=(13.0, 7.6), dpi=130, layout="constrained")
    places: Any = figure.subplot_mosaic(
        [["map", "buses"], ["map", "boardings"], ["map", "headways"]], width_ratios=[2.0, 1.0]
    )
    _plot_map(places["map"], tables, trips, day)
    _plot_buses(places["buses"], trips)
    _plot_boardings(places["boardings"], tables, day)
    _plot_headways(places["headways"], trips)
    for place in ("boardings", "headways"):
        places[place].sharex(places["buses"])
    places["buses"].autoscale(axis="x")
    begin, end = places["buses"].get_xlim()
    places["buses"].xaxis.set_major_locator(
        MultipleLocator(next(step for step in _TICKS_H if end - begin <= _MOST_TICKS * step))
    )
    places["buses"].xaxis.set_major_formatter(lambda hours, _: clock(hours))
    figure.suptitle(title)
    return figure


def _plot_map(axes: "Axes", tables: Tables, trips: pd.DataFrame, day: str) -> None:
    """Plot the links by load and the stops by boardings."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm
    from matplotlib.lines import Line2D

    line_of = tables.patterns.set_index("pattern")["line"]
    calls = link_loads(tables, day)
    calls = calls[calls["pattern"].isin(trips["pattern"])].assign(
        line=lambda rows: line_of.reindex(rows["pattern"]).to_numpy()
    )
    places = tables.stops.set_index("stop")
    latitude = float(places["lat"].mean())
    across = math.cos(math.radians(latitude)) * METRES_PER_DEGREE / 1000.0
    x = (places["lon"] - places["lon"].min()) * across
    y = (places["lat"] - places["lat"].min()) * METRES_PER_DEGREE / 1000.0
    departures = trips.groupby("pattern").size()
    inner = calls[calls["seq0"] > 0].merge(tables.links[["link", "from_stop"]], on="link")
    inner["departures"] = departures.reindex(inner["pattern"]).to_numpy()
    lines = sorted(inner["line"].unique())
    of_lines = len(lines) <= _LINE_COLOURS
    ways = ["from_stop", "stop", *(["line"] if of_lines else [])]
    links = inner.groupby(ways, as_index=False)[["load", "departures"]].sum()
    # Wide links are plotted first, so that other lines on the same links stay visible on top.
    links = links.sort_values("load", ascending=not of_lines)
    ends = [
        np.column_stack((x.reindex(links[stop]).to_numpy(), y.reindex(links[stop]).to_numpy()))
        for stop in ("from_stop", "stop")
    ]
    widths = 0.5 + _MAX_LINK_WIDTH * links["load"].to_numpy() / max(float(links["load"].max()), 1e-9)
    hours = float((trips["dep_s"].max() - trips["dep_s"].min()) / 3600.0)
    if of_lines:
        colour = {line: colormaps["tab10"](i) for i, line in enumerate(lines)}
        colours: Any = [colour[line] for line in links["line"]]
        handles = [Line2D([], [], color=colour[line], linewidth=3.0, label=line) for line in lines]
        axes.legend(handles=handles, title="line", loc="best", fontsize="small")
    else:
        scale = LogNorm(*_HEADWAYS_MIN)
        headway = 60.0 * max(hours, 1.0) / links["departures"].to_numpy(np.float64)
        colours = colormaps["plasma"](scale(np.clip(headway, *_HEADWAYS_MIN)))
        figure = axes.get_figure()
        assert figure is not None
        bar = figure.colorbar(
            ScalarMappable(scale, colormaps["plasma"]), ax=axes, location="bottom", shrink=0.6, aspect=40
        )
        ticks = [5, 10, 15, 20, 30, 60]
        bar.set_ticks(ticks, labels=[str(tick) for tick in ticks])
        bar.ax.minorticks_off()
        bar.set_label("minutes between buses on a link, all lines, mean of the day")
    axes.add_collection(
        LineCollection(
            list(np.stack(ends, axis=1)), linewidths=widths, colors=colours, capstyle="round", zorder=2
        )
    )
    board = tables.demand[tables.demand["daytype"] == day].groupby(["pattern", "seq0"])["board"].sum()
    at = calls.set_index(["pattern", "seq0"])["stop"].reindex(board.index)
    boarding = board.groupby(at.to_numpy()).sum()
    sizes = 60.0 * boarding.to_numpy() / max(float(boarding.max()), 1e-9)
    axes.scatter(
        x.reindex(boarding.index),
        y.reindex(boarding.index),
        sizes + 0.5,
        color="#222222",
        zorder=3,
        linewidths=0,
    )
    axes.set_aspect("equal")
    axes.autoscale()
    axes.margins(0.03)
    # A line whose stops lie nearly along one axis would otherwise be a strip hidden by its legend.
    axes.set_xlim(_widened(axes.get_xlim(), _MIN_ASPECT * float(np.ptp(axes.get_ylim()))))
    axes.set_ylim(_widened(axes.get_ylim(), _MIN_ASPECT * float(np.ptp(axes.get_xlim()))))
    axes.set_xlabel("km to the east")
    axes.set_ylabel("km to the north")
    axes.set_title(
        f"link width: passengers (largest: {links['load'].max():,.0f} per day); stop size: boardings "
        f"(largest: {boarding.max():,.0f} per day)",
        fontsize="medium",
    )


def _widened(limits: tuple[float, float], least: float) -> tuple[float, float]:
    """Return the limits of an axis, at least `least` apart, with the same middle."""
    more = max(least - (limits[1] - limits[0]), 0.0) / 2.0
    return limits[0] - more, limits[1] + more


def _plot_buses(axes: "Axes", trips: pd.DataFrame) -> None:
    times, buses = buses_at_once(trips)
    axes.plot(times / 3600.0, buses, color="#0072B2", linewidth=1.0, drawstyle="steps-post")
    axes.set_ylim(bottom=0)
    axes.set_title(f"buses on the road (maximum {buses.max():,})", fontsize="medium")


def _plot_boardings(axes: "Axes", tables: Tables, day: str) -> None:
    by_hour = tables.demand[tables.demand["daytype"] == day].groupby("hour")["board"].sum()
    axes.bar(by_hour.index.to_numpy(np.float64) + 0.5, by_hour.to_numpy(), width=0.9, color="#009E73")
    axes.set_title(f"boardings per hour ({by_hour.sum():,.0f} per day)", fontsize="medium")


def _plot_headways(axes: "Axes", trips: pd.DataFrame) -> None:
    """Plot the quartiles over patterns of the time between departures, by hour."""
    ordered = trips.sort_values(["pattern", "dep_s"])
    gap = ordered["dep_s"].diff().where(ordered["pattern"] == ordered["pattern"].shift()) / 60.0
    hour = (ordered["dep_s"] // 3600)[gap.notna()]
    means = gap.dropna().groupby([hour, ordered["pattern"][gap.notna()]]).mean()
    low, middle, high = (means.groupby(level=0).quantile(q) for q in (0.25, 0.5, 0.75))
    hours = middle.index.to_numpy(np.float64) + 0.5
    axes.fill_between(hours, low.to_numpy(), high.to_numpy(), color="#E69F00", alpha=0.4, linewidth=0)
    axes.plot(hours, middle.to_numpy(), color="#D55E00")
    axes.set_ylim(bottom=0)
    axes.set_title("headways of patterns, min: median and quartiles", fontsize="medium")
    axes.set_xlabel("time of day")

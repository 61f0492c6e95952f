"""Energy, CO2 and CPU time of runs."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from headway.stats.plots.labels import label_rows, legends_beside, rows_height, wrapped_name
from headway.stats.plots.limits import outliers
from headway.stats.plots.style import LINE_STYLES, MARKERS, THOUSANDS, four_digits, new_figure, style_axes

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_PARTS = {"cpu_kwh": "CPU", "gpu_kwh": "GPU", "ram_kwh": "RAM"}
_PART_COLOURS = {"cpu_kwh": "#4477AA", "gpu_kwh": "#CCBB44", "ram_kwh": "#AAAAAA"}
_LEAST_SPAN = 0.1
"""Least span of an axis of costs, relative to its middle, so that noise does not look like a difference."""


def footprint(energy: "pd.DataFrame", units: Mapping[str, tuple[str, float]]) -> "Figure":
    """Plot the mean costs per run of each controller (the index), with standard deviations.

    Panels side by side: CO2 if `units` has `kg_co2`, energy by part, CPU seconds. `energy` has the columns
    `kg_co2`, `kwh`, `cpu_kwh`, `gpu_kwh`, `ram_kwh`, `cpu_seconds`, `kg_co2_std`, `kwh_std` and
    `cpu_seconds_std`. `units` gives (unit, factor) of `kwh` and, if it is known, of `kg_co2`.
    """
    places, names = np.arange(len(energy)), [wrapped_name(str(name)) for name in energy.index]
    figure = new_figure(1.4 + rows_height(names))
    panels = list(figure.subplots(1, 3 if "kg_co2" in units else 2, sharey=True))
    middle, right = panels[-2:]
    errors: dict[str, Any] = {"capsize": 3, "ecolor": "0.25", "height": 0.6}
    kwh_unit, kwh_factor = units["kwh"]
    labels = [f"{kwh_unit} per run", "CPU s per run"]
    if "kg_co2" in units:
        co2_unit, co2_factor = units["kg_co2"]
        labels = [f"{co2_unit} CO2eq per run", *labels]
        spread = energy["kg_co2_std"].fillna(0) * co2_factor
        panels[0].barh(places, energy["kg_co2"] * co2_factor, xerr=spread, color="#228833", **errors)
    ends = np.zeros(len(energy))
    for part, name in _PARTS.items():
        share = energy[part].fillna(0).to_numpy() * kwh_factor
        if share.any():
            middle.barh(places, share, left=ends, color=_PART_COLOURS[part], label=name, height=0.6)
        ends = ends + share
    spread = energy["kwh_std"].fillna(0) * kwh_factor
    middle.errorbar(ends, places, xerr=spread, fmt="none", ecolor="0.25", capsize=3)
    right.barh(
        places, energy["cpu_seconds"], xerr=energy["cpu_seconds_std"].fillna(0), color="#66CCEE", **errors
    )
    label_rows(panels[0], names)
    for axes, letter, label in zip(panels, "abc", labels, strict=False):
        style_axes(axes, f"({letter}) {label}", "")
        axes.set_xlim(left=0)
    figure.legend(fontsize="small", loc="outside lower center", ncols=len(_PARTS), frameon=False)
    return figure


def reward_against_cost(
    runs: "pd.DataFrame",
    cost: str,
    factor: float,
    labels: tuple[str, str],
    styles: Mapping[str, Mapping[str, Any]],
    sign: int = 1,
) -> "Figure":
    """Plot each run's `final_reward` over its `cost`, with a ring at each controller's mean, one panel per
    task.

    `cost` is a column of `runs`, multiplied by `factor`; `labels` are those of the horizontal and the
    vertical axis. Controllers far worse than most (`outliers`, see there for `sign`) are in the legend only.
    """
    tasks = list(dict.fromkeys(runs["task"]))
    figure = new_figure(3.7 * len(tasks))
    panels = figure.subplots(len(tasks), squeeze=False)[:, 0]
    for task, axes in zip(tasks, panels, strict=True):
        grouped = runs[runs["task"] == task].groupby("controller", sort=False)
        by_name = {str(name): of_name for name, of_name in grouped}
        excluded = outliers(
            {name: of_name["final_reward"].to_numpy() for name, of_name in by_name.items()}, sign
        )
        for name, of_name in by_name.items():
            colour, spent = styles[name]["color"], of_name[cost] * factor
            marker = MARKERS[LINE_STYLES.index(styles[name]["linestyle"])]
            ring: dict[str, Any] = {"s": 70, "facecolors": "none", "edgecolors": colour, "linewidths": 2}
            ring["marker"] = marker
            mean = (spent.mean(), of_name["final_reward"].mean())
            if name in excluded:
                axes.scatter([], [], label=f"{name} (off scale: {four_digits(mean[1])})", **ring)
                continue
            axes.scatter(
                spent, of_name["final_reward"], s=18, color=colour, alpha=0.6, linewidths=0, marker=marker
            )
            axes.scatter(*mean, label=name, **ring)
        if len(tasks) > 1:
            axes.set_title(task, loc="left", fontsize="medium")
        low, high = axes.get_xlim()
        middle = (low + high) / 2
        half = max(high - low, _LEAST_SPAN * middle) / 2
        axes.set_xlim(middle - half, middle + half)
        style_axes(axes, *labels)
        axes.yaxis.set_major_formatter(THOUSANDS)
    legends_beside(figure, panels)
    return figure

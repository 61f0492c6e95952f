"""Curves over environment steps or over the values of a setting."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from headway.contracts.errors import HeadwayError
from headway.stats.plots.labels import label_ends, wrapped_name
from headway.stats.plots.limits import bound_bands, extend_axis, note_cut_bands, outliers
from headway.stats.plots.rules import near_rules, plot_rules
from headway.stats.plots.style import (
    COLOURS,
    SHADE,
    THOUSANDS,
    format_steps,
    four_digits,
    new_figure,
    point_markers,
    style_axes,
)
from headway.wording import counted

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEWEST_SEEDS = 3
"""Minimum number of seeds for a band: with two, the 95% interval is 12.7 times as wide as they are apart."""
_MOST_OVERLAP = 3.0
"""Mean widths of a panel's intervals, summed, over the range of its curves: up to this they are shaded bands;
more would overlap to one grey surface, and are outlined."""


def learning_curves(
    means: "pd.DataFrame",
    rules: Mapping[str, Mapping[str, float]],
    label: str,
    styles: Mapping[str, Mapping[str, Any]],
    low: float | None = None,
    title: str = "",
    sign: int = 1,
    stage_ends: Mapping[str, Sequence[int]] | None = None,
    rule_phases: Mapping[str, Mapping[str, tuple[str, int]]] | None = None,
) -> "Figure":
    """Plot the frame of `mean_curves` (column `mean`) or `efficiency` (column `iqm`), one panel per task.

    Each controller is a line with its interval, of at least three seeds, as a band, or between two thin
    lines where bands would overlap much. `rules` (task -> rule -> value) are horizontal lines. Lines are
    labelled at their right ends; a rule too far away is only listed there. The vertical axis is not stretched
    for a controller far worse than most others (`outliers`; higher is better if `sign` is 1, lower if -1),
    whose label has its worst value, nor for intervals much wider than the range of the curves, which are cut
    off. `low` is the lower limit of the vertical axis. `stage_ends` (task -> environment steps) are vertical
    lines. `rule_phases` (task -> controller -> rule and environment steps) are shaded from 0 on: steps in
    which that rule acted in training.
    """
    column = "mean" if "mean" in means.columns else "iqm"
    tasks = list(dict.fromkeys(means["task"])) if "task" in means.columns else [""]
    figure = new_figure(3.9 * len(tasks) + 0.3 * bool(title))
    panels = figure.subplots(len(tasks), squeeze=False)[:, 0]
    for task, axes in zip(tasks, panels, strict=True):
        of_task = means[means["task"] == task] if task else means
        by_name = {str(name): curve for name, curve in of_task.groupby("controller", sort=False)}
        excluded = outliers({name: curve[column].to_numpy() for name, curve in by_name.items()}, sign)
        shown = of_task[~of_task["controller"].isin(list(excluded))]
        widths = (shown["high"] - shown["low"]).groupby(shown["controller"]).mean()
        shaded = bool(widths.sum() <= _MOST_OVERLAP * np.ptp(shown[column].dropna()))
        for name, curve in by_name.items():
            if name not in excluded:
                _plot_curve(axes, name, curve, column, styles[name], shaded)
        band_low, band_high = axes.get_ylim()
        bound_bands(axes, shown[column].to_numpy())
        plot_rules(axes, rules.get(task, {}), styles=styles, sign=sign)
        note_cut_bands(axes, band_low, band_high)
        for steps in (stage_ends or {}).get(task, ()):
            axes.axvline(steps, color="0.7", linewidth=0.8, zorder=0)
        _shade_rule_phases(axes, (rule_phases or {}).get(task, {}), len(by_name), sign)
        if excluded:
            window = axes.get_ylim()
            for name, value in excluded.items():
                remark = f" (off scale: {four_digits(value)})"
                _plot_curve(axes, name, by_name[name], column, styles[name], shaded, remark)
            axes.set_ylim(window)
        if low is not None:
            top = axes.get_ylim()[1]
            if not -np.inf < low < top:
                raise HeadwayError(f"the axis cannot begin at {low:g}: give a number below {top:.4g}")
            axes.set_ylim(bottom=low)
        style_axes(axes, "environment steps", label)
        format_steps(axes)
        axes.yaxis.set_major_formatter(THOUSANDS)
        if len(tasks) > 1:
            axes.set_title(task, loc="left", fontsize="medium")
    if title:
        figure.suptitle(title)
    label_ends(figure, list(panels))
    return figure


def _shade_rule_phases(axes: "Axes", phases: Mapping[str, tuple[str, int]], curves: int, sign: int) -> None:
    """Shade the steps in which a rule acted and name it at their end, one text per rule and end.

    The text is where curves hardly run after a rule's phase: at the bottom if higher is better.
    """
    controllers: dict[tuple[int, str], list[str]] = {}
    for name, (rule, steps) in phases.items():
        controllers.setdefault((steps, rule), []).append(name)
    edge, up = (0.0, 1) if sign > 0 else (1.0, -1)
    middle, lines = sum(axes.get_xlim()) / 2.0, 0
    for (steps, rule), names in sorted(controllers.items()):
        whose = (
            "" if len(names) == curves else f" ({names[0]})" if len(names) == 1 else f" ({len(names)} curves)"
        )
        text = wrapped_name(f"rule {rule} acts until here{whose}")
        axes.axvspan(0, steps, color="0.5", alpha=0.12, linewidth=0, zorder=0)
        axes.annotate(
            text,
            xy=(steps, edge),
            xycoords=("data", "axes fraction"),
            xytext=(3 if steps < middle else -3, up * (4 + 11 * lines)),
            textcoords="offset points",
            fontsize="small",
            color="0.35",
            horizontalalignment="left" if steps < middle else "right",
            verticalalignment="bottom" if up > 0 else "top",
            bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0},
        )
        lines += 1 + text.count("\n")


def run_curves(curves: Mapping[str, Mapping[int, float]], title: str) -> "Figure":
    """Plot the curves of one run, one panel each: label -> environment steps -> value."""
    figure = new_figure(1.0 + 2.2 * len(curves))
    for (label, points), axes in zip(
        curves.items(), figure.subplots(len(curves), squeeze=False, sharex=True)[:, 0], strict=True
    ):
        marks = point_markers(len(points))
        axes.plot(list(points), list(points.values()), color=COLOURS[0], linewidth=1.4, **marks)
        style_axes(axes, "", label)
        format_steps(axes)
        axes.yaxis.set_major_formatter(THOUSANDS)
    axes.set_xlabel("environment steps")
    figure.suptitle(title, fontsize="medium")
    return figure


def _plot_curve(
    axes: "Axes",
    name: str,
    curve: "pd.DataFrame",
    column: str,
    style: Mapping[str, Any],
    shaded: bool,
    remark: str = "",
) -> None:
    """Plot a controller's line and its interval, if it has enough seeds: as a band or by its outlines."""
    seeds = int(curve["runs"].iloc[0]) if "runs" in curve else FEWEST_SEEDS
    runs = f" ({counted(seeds, 'seed')})" if "runs" in curve else ""
    steps, middle = curve["env_steps"].to_numpy(), curve[column].to_numpy()
    axes.plot(
        steps, middle, label=f"{name}{runs}{remark}", linewidth=1.6, **point_markers(len(steps)), **style
    )
    if seeds >= FEWEST_SEEDS:
        ends = (curve["low"].to_numpy(), curve["high"].to_numpy())
        if shaded:
            axes.fill_between(steps, *ends, color=style["color"], alpha=SHADE, linewidth=0)
        for end in () if shaded else ends:
            axes.plot(steps, end, linewidth=0.6, alpha=0.6, **style)


def by_setting(
    points: "pd.DataFrame",
    setting: str,
    label: str,
    styles: Mapping[str, Mapping[str, Any]],
    sign: int = 1,
) -> "Figure":
    """Plot results by the value of a setting, one panel per `group`.

    `points`: columns `group`, `controller`, `setting` (the value), `runs` (0 for a rule), `mean`, `low` and
    `high`, the ends of the interval over runs, which is shown from three on. Rules far from the learners
    (`near_rules`, see there for `sign`) are only listed.
    """
    groups = list(dict.fromkeys(points["group"]))
    figure = new_figure(3.9 * len(groups))
    panels = figure.subplots(len(groups), squeeze=False, sharex=True)[:, 0]
    for group, axes in zip(groups, panels, strict=True):
        of_group = points[points["group"] == group]
        learned = of_group[of_group["runs"] > 0]
        for name, curve in learned.groupby("controller", sort=False):
            fewest, most = int(curve["runs"].min()), int(curve["runs"].max())
            seeds = f"{f'{fewest} to ' if fewest < most else ''}{counted(most, 'seed')}"
            style, markers = styles[str(name)], point_markers(len(curve))
            axes.plot(
                curve["setting"], curve["mean"], label=f"{name} ({seeds})", linewidth=1.6, **markers, **style
            )
            band = curve[curve["runs"] >= FEWEST_SEEDS]
            ends = (band["low"].to_numpy(), band["high"].to_numpy())
            axes.fill_between(band["setting"], *ends, color=style["color"], alpha=SHADE, linewidth=0)
        bands = axes.get_ylim()
        bound_bands(axes, learned["mean"].to_numpy())
        rules = {
            str(name): rule
            for name, rule in of_group[of_group["runs"] == 0].groupby("controller", sort=False)
        }
        means = {name: float(rule["mean"].mean()) for name, rule in rules.items()}
        low, high = axes.get_ylim()
        near = near_rules(means, low, high, sign)
        extend_axis(axes, [value for name in near for value in rules[name]["mean"]])
        note_cut_bands(axes, *bands)
        for name, rule in rules.items():
            if name in near:
                axes.plot(
                    rule["setting"], rule["mean"], label=name, **point_markers(len(rule)), **styles[name]
                )
            else:
                axes.plot([], [], label=f"{name} (off scale: {four_digits(means[name])})", **styles[name])
        axes.xaxis.get_major_locator().set_params(integer=bool((points["setting"] % 1 == 0).all()))
        style_axes(axes, setting if group == groups[-1] else "", label)
        axes.yaxis.set_major_formatter(THOUSANDS)
        axes.set_title(wrapped_name(group), loc="left", fontsize="medium")
    label_ends(figure, list(panels))
    return figure

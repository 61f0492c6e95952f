"""Plots of a study: frames of `headway.stats.frames` and `headway.store` in, matplotlib figures out.

Nothing is displayed or registered globally, so the plots work alike in a command, a report and a notebook. A
controller has the same colour in all plots that get the same `styles` from `colours`.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from headway.contracts.errors import HeadwayError
from headway.stats.plot_labels import (
    NAME_LENGTH,
    label_ends,
    label_height,
    label_rows,
    legends_beside,
    rows_height,
    wrapped_name,
)
from headway.wording import counted

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from headway.stats.best_of import BestOf

# Okabe and Ito's colours, safe for colour blindness (jfly.uni-koeln.de/color), then four of Tol's `muted`.
_COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9",
    "#882255", "#999933", "#332288", "#117733",
)  # fmt: skip
_LINE_STYLES: tuple[Any, ...] = ("-", (0, (5, 1)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (5, 1, 1, 1, 1, 1)))
"""Line styles of the first to the fifth round through the colours."""
_MARKERS = ("o", "s", "^", "D", "v")
"""Markers of the same rounds in scatter plots."""
FEWEST_SEEDS = 3
"""Minimum number of seeds for a band: with two, the 95% interval is 12.7 times as wide as they are apart."""
_OUTLIER_FACTOR = 5.0
"""Values farther from the others than this multiple of their range do not extend an axis; the legend states
them."""
_MAX_MARKED_POINTS = 60
"""Lines with at most this number of points have a marker at each point."""
_THOUSANDS = "{x:,.10g}"
"""Tick format with thousands separators, for matplotlib."""
_PARTS = {"cpu_kwh": "CPU", "gpu_kwh": "GPU", "ram_kwh": "RAM"}
_PART_COLOURS = {"cpu_kwh": "#4477AA", "gpu_kwh": "#CCBB44", "ram_kwh": "#AAAAAA"}
_WIDTH = 9.0
_DOTS_PER_INCH = 150
_SHADE, _SHADES = 0.18, 1.1
"""Opacity of one interval's band, and the sum over all bands of a panel."""
_LEAST_SPAN = 0.1
"""Least span of an axis of costs, relative to its middle, so that noise does not look like a difference."""
_MOST_OVERLAP = 3.0
"""Mean widths of a panel's intervals, summed, over the range of its curves: up to this they are shaded bands;
more would overlap to one grey surface, and are outlined."""


def colours(controllers: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the style (colour and line) of each controller, for matplotlib.

    After ten controllers the colours repeat with another line style.
    """
    return {
        name: {
            "color": _COLOURS[place % len(_COLOURS)],
            "linestyle": _LINE_STYLES[place // len(_COLOURS) % len(_LINE_STYLES)],
        }
        for place, name in enumerate(controllers)
    }


def rule_styles(rules: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the style of each rule's line by `rule NAME`: greys, each with its own dash pattern."""
    return {
        f"rule {rule}": {
            "linestyle": (0, pattern),
            "color": f"{0.15 + 0.45 * (place % 2):.2f}",
            "linewidth": 1,
        }
        for place, (rule, pattern) in enumerate(zip(rules, _dash_patterns(), strict=False))
    }


def _dash_patterns() -> Iterator[tuple[float, ...]]:
    """Yield lengths of dashes, dots and gaps: a dash, a dot, then ever more dashes and dots in turn."""
    yield from ((5.0, 2.0), (1.0, 2.0))
    for marks in count(2):
        for dots in range(1, marks):
            yield (5.0, 2.0) * (marks - dots) + (1.0, 2.0) * dots


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
    lines where bands would overlap much. `rules` (task -> rule ->
    value) are horizontal lines. Lines are labelled at their right ends; a rule too far away is only listed
    there. The vertical axis is not stretched for a controller far worse than most others (`outliers`; higher
    is better if `sign` is 1, lower if -1), whose label has its worst value, nor for intervals much wider than
    the range of the curves, which are cut off. `low` is the lower limit of the vertical axis.
    `stage_ends` (task -> environment steps) are vertical lines. `rule_phases` (task -> controller -> rule and
    environment steps) are shaded from 0 on: steps in which that rule acted in training.
    """
    column = "mean" if "mean" in means.columns else "iqm"
    tasks = list(dict.fromkeys(means["task"])) if "task" in means.columns else [""]
    figure = _figure(3.9 * len(tasks) + 0.3 * bool(title))
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
        _bound_bands(axes, shown[column].to_numpy())
        plot_rules(axes, rules.get(task, {}), styles=styles, sign=sign)
        _note_cut_bands(axes, band_low, band_high)
        for steps in (stage_ends or {}).get(task, ()):
            axes.axvline(steps, color="0.7", linewidth=0.8, zorder=0)
        _shade_rule_phases(axes, (rule_phases or {}).get(task, {}), len(by_name), sign)
        if excluded:
            window = axes.get_ylim()
            for name, value in excluded.items():
                remark = f" (off scale: {_four_digits(value)})"
                _plot_curve(axes, name, by_name[name], column, styles[name], shaded, remark)
            axes.set_ylim(window)
        if low is not None:
            if low >= (top := axes.get_ylim()[1]):
                raise HeadwayError(f"the axis cannot begin at {low:g}: all values lie below {top:.4g}")
            axes.set_ylim(bottom=low)
        _style_axes(axes, "environment steps", label)
        _format_steps(axes)
        axes.yaxis.set_major_formatter(_THOUSANDS)
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
    figure = _figure(1.0 + 2.2 * len(curves))
    for (label, points), axes in zip(
        curves.items(), figure.subplots(len(curves), squeeze=False, sharex=True)[:, 0], strict=True
    ):
        marks = _point_markers(len(points))
        axes.plot(list(points), list(points.values()), color=_COLOURS[0], linewidth=1.4, **marks)
        _style_axes(axes, "", label)
        _format_steps(axes)
        axes.yaxis.set_major_formatter(_THOUSANDS)
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
        steps, middle, label=f"{name}{runs}{remark}", linewidth=1.6, **_point_markers(len(steps)), **style
    )
    if seeds >= FEWEST_SEEDS:
        ends = (curve["low"].to_numpy(), curve["high"].to_numpy())
        if shaded:
            axes.fill_between(steps, *ends, color=style["color"], alpha=_SHADE, linewidth=0)
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
    figure = _figure(3.9 * len(groups))
    panels = figure.subplots(len(groups), squeeze=False, sharex=True)[:, 0]
    for group, axes in zip(groups, panels, strict=True):
        of_group = points[points["group"] == group]
        learned = of_group[of_group["runs"] > 0]
        for name, curve in learned.groupby("controller", sort=False):
            fewest, most = int(curve["runs"].min()), int(curve["runs"].max())
            seeds = f"{f'{fewest} to ' if fewest < most else ''}{counted(most, 'seed')}"
            style, markers = styles[str(name)], _point_markers(len(curve))
            axes.plot(
                curve["setting"], curve["mean"], label=f"{name} ({seeds})", linewidth=1.6, **markers, **style
            )
            band = curve[curve["runs"] >= FEWEST_SEEDS]
            ends = (band["low"].to_numpy(), band["high"].to_numpy())
            axes.fill_between(band["setting"], *ends, color=style["color"], alpha=_SHADE, linewidth=0)
        bands = axes.get_ylim()
        _bound_bands(axes, learned["mean"].to_numpy())
        rules = {
            str(name): rule
            for name, rule in of_group[of_group["runs"] == 0].groupby("controller", sort=False)
        }
        means = {name: float(rule["mean"].mean()) for name, rule in rules.items()}
        low, high = axes.get_ylim()
        near = near_rules(means, low, high, sign)
        _extend_axis(axes, [value for name in near for value in rules[name]["mean"]])
        _note_cut_bands(axes, *bands)
        for name, rule in rules.items():
            if name in near:
                axes.plot(
                    rule["setting"], rule["mean"], label=name, **_point_markers(len(rule)), **styles[name]
                )
            else:
                axes.plot([], [], label=f"{name} (off scale: {_four_digits(means[name])})", **styles[name])
        axes.xaxis.get_major_locator().set_params(integer=bool((points["setting"] % 1 == 0).all()))
        _style_axes(axes, setting if group == groups[-1] else "", label)
        axes.yaxis.set_major_formatter(_THOUSANDS)
        axes.set_title(wrapped_name(group), loc="left", fontsize="medium")
    label_ends(figure, list(panels))
    return figure


def _bound_bands(axes: "Axes", middles: "NDArray[np.floating[Any]]") -> None:
    """Let bands extend the vertical axis to twice the range of the curves at most.

    The intervals of two seeds can be a hundred times as wide as that range and would flatten all curves.
    """
    low, high = float(np.nanmin(middles)), float(np.nanmax(middles))
    if low < high:
        beyond, (bottom, top) = 0.5 * (high - low), axes.get_ylim()
        axes.set_ylim(max(bottom, low - beyond), min(top, high + beyond))


def _note_cut_bands(axes: "Axes", low: float, high: float) -> None:
    """Note above a panel that its axis does not show all of the bands, which extend from `low` to `high`."""
    bottom, top = axes.get_ylim()
    if low < bottom or high > top:
        axes.set_title("some intervals continue beyond the axis", loc="right", fontsize="small", color="0.35")


def _point_markers(points: int) -> dict[str, Any]:
    """Return markers for short curves, so that a line between two points does not look like a dense curve."""
    return {"marker": "o", "markersize": 3.5} if points <= _MAX_MARKED_POINTS else {}


def plot_rules(
    axes: "Axes",
    rules: Mapping[str, float],
    upright: bool = False,
    styles: Mapping[str, Mapping[str, Any]] | None = None,
    sign: int = 1,
) -> None:
    """Plot each rule as a grey horizontal line, or a vertical one if `upright`.

    Order and style are those of `rule_styles` in `styles`, or else the highest rule comes first.

    Distant rules are only listed in the legend, except for the best one: the highest if `sign` is 1, the
    lowest if -1. A vertical axis with fixed limits is extended to the
    plotted rules.
    """
    low, high = axes.get_xlim() if upright else axes.get_ylim()
    near = near_rules(rules, low, high, sign)
    plot_line = axes.axvline if upright else axes.axhline
    names = {f"rule {rule}": rule for rule in rules}
    own: Mapping[str, Mapping[str, Any]]
    own = {name: style for name, style in (styles or {}).items() if name in names}
    if len(own) < len(rules):
        own = rule_styles(sorted(rules, key=lambda rule: -rules[rule]))
    for name, style in own.items():
        value = rules[names[name]]
        if names[name] in near:
            plot_line(value, label=name, **style)
        else:
            axes.plot([], [], label=f"{name} (off scale: {_four_digits(value)})", **style)
    if not upright and not axes.get_autoscaley_on():
        _extend_axis(axes, [rules[rule] for rule in near])


def _extend_axis(axes: "Axes", values: Sequence[float]) -> None:
    """Extend the vertical axis to `values`, with a margin beyond them."""
    if not values:
        return
    low, high = axes.get_ylim()
    edge = 0.05 * (max(high, *values) - min(low, *values))
    axes.set_ylim(min(low, min(values) - edge), max(high, max(values) + edge))


def near_rules(rules: Mapping[str, float], low: float, high: float, sign: int = 1) -> set[str]:
    """Return the rules that may extend an axis from `low` to `high`.

    The best rule, the highest if `sign` is 1 or the lowest if -1, always may. Others are added in order of
    distance until the next one is farther away than five times the range so far. A rule that fails, such as
    random bus control, would flatten all curves.
    """

    def distance(rule: str) -> float:
        return max(low - rules[rule], rules[rule] - high, 0.0)

    if not rules:
        return set()
    best = max(rules, key=lambda rule: sign * rules[rule])
    near, low, high = {best}, min(low, rules[best]), max(high, rules[best])
    for rule in sorted(rules, key=distance):
        if distance(rule) > _OUTLIER_FACTOR * (high - low):
            break
        near.add(rule)
        low, high = min(low, rules[rule]), max(high, rules[rule])
    return near


def outliers(values: Mapping[str, "NDArray[np.floating[Any]]"], sign: int = 1) -> dict[str, float]:
    """Return the worst value of each controller that is far worse than most, such as one that diverged.

    "Most" are the more than half of the controllers whose ranges lie closest together; far is more than five
    times their range, or five times the median range of all controllers if that is wider. Higher is better if
    `sign` is 1, lower if -1; far better is never an outlier. With fewer than three controllers there are
    none.
    """
    known = {name: of_name[np.isfinite(of_name)] for name, of_name in values.items()}
    known = {name: of_name for name, of_name in known.items() if len(of_name)}
    if len(known) < 3:
        return {}
    ranges = sorted((float(of_name.min()), float(of_name.max())) for of_name in known.values())
    most = len(ranges) // 2 + 1
    together = [ranges[first : first + most] for first in range(len(ranges) - most + 1)]
    low, high = min(
        ((near[0][0], max(end for _, end in near)) for near in together), key=lambda ends: ends[1] - ends[0]
    )
    # Points of few seeds may agree by chance: without a usual range there are no outliers.
    usual = float(np.diff(np.median(ranges, axis=0))[0])
    excluded = {}
    for name, of_name in known.items():
        distances = np.maximum(low - of_name if sign > 0 else of_name - high, 0.0)
        if usual > 0 and distances.max() > _OUTLIER_FACTOR * max(high - low, usual):
            excluded[name] = float(of_name[distances.argmax()])
    return excluded


def intervals(
    summary: "pd.DataFrame",
    rules: Mapping[str, float],
    label: str,
    styles: Mapping[str, Mapping[str, Any]],
    sign: int = 1,
) -> "Figure":
    """Plot the frame of `summary`: each controller's interquartile mean and its interval, one row each.

    Rules are vertical lines; distant ones are in the legend only. Controllers far worse than most
    (`outliers`, see there for `sign`) are named with their value and not plotted.
    """
    names = [str(name) for name in summary.index]
    ends = summary[["iqm", "iqm_low", "iqm_high"]].to_numpy()
    excluded = outliers(dict(zip(names, ends, strict=True)), sign)
    beside = [
        wrapped_name(name) + (f"\n(off scale: {_four_digits(float(own[0]))})" if name in excluded else "")
        for name, own in zip(names, ends, strict=True)
    ]
    figure = _figure(0.9 + rows_height(beside) + 0.2 * len(rules))
    axes = figure.subplots()
    for place, name in enumerate(names):
        row, colour = summary.loc[name], styles[name]["color"]
        if name in excluded:
            continue
        axes.barh(
            place, row["iqm_high"] - row["iqm_low"], left=row["iqm_low"], height=0.5, color=colour, alpha=0.45
        )
        axes.plot([row["iqm"]] * 2, [place - 0.25, place + 0.25], color=colour, linewidth=2.5)
    plot_rules(axes, rules, upright=True, styles=styles, sign=sign)
    axes.use_sticky_edges = False  # otherwise the margins would not apply to the bars
    axes.margins(x=0.05)
    label_rows(axes, beside)
    _style_axes(axes, label, "")
    axes.xaxis.set_major_formatter(_THOUSANDS)
    if rules:
        legends_beside(figure, [axes])
    return figure


def performance_profiles(
    profiles: "pd.DataFrame", label: str, styles: Mapping[str, Mapping[str, Any]]
) -> "Figure":
    """Plot the frame of `profiles`: the share of runs above each score."""
    figure = _figure(3.9)
    axes = figure.subplots()
    for controller, profile in profiles.groupby("controller", sort=False):
        name, points = str(controller), profile["threshold"].to_numpy()
        axes.step(points, profile["share"], where="post", label=name, linewidth=1.6, **styles[name])
        ends = (profile["low"].to_numpy(), profile["high"].to_numpy())
        axes.fill_between(points, *ends, step="post", color=styles[name]["color"], alpha=0.15, linewidth=0)
    axes.set_ylim(-0.02, 1.02)
    _style_axes(axes, f"{label} above", "share of runs")
    legends_beside(figure, [axes])
    return figure


def rank_diagram(average_ranks: Mapping[str, float], groups: Sequence[tuple[int, int]]) -> "Figure":
    """Plot a critical-difference diagram (Demsar 2006) of controllers, best average rank first.

    `groups`: first and last place in that order of the controllers that a bar joins. The better half of the
    names is at the left of the axis of ranks, the others at the right.
    """
    places = list(average_ranks.values())
    count, left = len(places), (len(places) + 1) // 2
    labels = [wrapped_name(f"{name} ({_four_digits(rank)})") for name, rank in average_ranks.items()]
    row = 0.1 + max(label_height(label) for label in labels)
    bars = 0.12 * (len(groups) + 1)
    figure = _figure(0.6 + bars + row * left)
    axes = figure.subplots()
    margin = 0.04 * max(count - 1, 1)
    axes.set_xlim(1 - margin, count + margin)
    axes.set_ylim(bars + row * left, 0)
    axes.xaxis.tick_top()
    axes.xaxis.set_label_position("top")
    axes.set_xlabel("average rank")
    axes.set_xticks(range(1, count + 1))
    axes.set_yticks([])
    for side in ("left", "right", "bottom"):
        axes.spines[side].set_visible(False)
    for place, (label, rank) in enumerate(zip(labels, places, strict=True)):
        is_left = place < left
        depth = bars + row * (0.5 + (place if is_left else count - 1 - place))
        edge = 1 - margin if is_left else count + margin
        axes.plot([rank, rank, edge], [0, depth, depth], color="0.3", linewidth=0.9)
        axes.annotate(
            label,
            xy=(edge, depth),
            xytext=(-4 if is_left else 4, 0),
            textcoords="offset points",
            fontsize="small",
            horizontalalignment="right" if is_left else "left",
            verticalalignment="center",
            annotation_clip=False,
        )
    for place, (first, last) in enumerate(groups):
        ends = [places[first] - 0.3 * margin, places[last] + 0.3 * margin]
        axes.plot(ends, [0.12 * (place + 1)] * 2, color="0.1", linewidth=3.5, solid_capstyle="butt")
    return figure


def best_of_n(
    curves: "Mapping[str, BestOf]", label: str, styles: Mapping[str, Mapping[str, Any]], title: str
) -> "Figure":
    """Plot the expected best of n candidates over n, one line per algorithm, with its standard deviation."""
    figure = _figure(4.2)
    axes = figure.subplots()
    shade = min(_SHADE, _SHADES / max(len(curves), 1))
    for name, best in curves.items():
        n = np.arange(1, len(best.mean) + 1)
        axes.plot(n, best.mean, label=name, linewidth=1.6, **_point_markers(len(n)), **styles[name])
        axes.fill_between(
            n,
            best.mean - best.std,
            best.mean + best.std,
            color=styles[name]["color"],
            alpha=shade,
            linewidth=0,
        )
    _bound_bands(axes, np.concatenate([best.mean for best in curves.values()]))
    axes.locator_params(axis="x", integer=True)
    _style_axes(axes, "candidates n", label)
    axes.yaxis.set_major_formatter(_THOUSANDS)
    figure.suptitle(title)
    legends_beside(figure, [axes])
    return figure


def footprint(energy: "pd.DataFrame", units: Mapping[str, tuple[str, float]]) -> "Figure":
    """Plot the mean costs per run of each controller (the index), with standard deviations.

    Panels side by side: CO2 if `units` has `kg_co2`, energy by part, CPU seconds. `energy` has the columns
    `kg_co2`, `kwh`, `cpu_kwh`, `gpu_kwh`, `ram_kwh`, `cpu_seconds`, `kg_co2_std`, `kwh_std` and
    `cpu_seconds_std`. `units` gives (unit, factor) of `kwh` and, if it is known, of `kg_co2`.
    """
    places, names = np.arange(len(energy)), [wrapped_name(str(name)) for name in energy.index]
    figure = _figure(1.4 + rows_height(names))
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
        _style_axes(axes, f"({letter}) {label}", "")
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
    figure = _figure(3.7 * len(tasks))
    panels = figure.subplots(len(tasks), squeeze=False)[:, 0]
    for task, axes in zip(tasks, panels, strict=True):
        grouped = runs[runs["task"] == task].groupby("controller", sort=False)
        by_name = {str(name): of_name for name, of_name in grouped}
        excluded = outliers(
            {name: of_name["final_reward"].to_numpy() for name, of_name in by_name.items()}, sign
        )
        for name, of_name in by_name.items():
            colour, spent = styles[name]["color"], of_name[cost] * factor
            marker = _MARKERS[_LINE_STYLES.index(styles[name]["linestyle"])]
            ring: dict[str, Any] = {"s": 70, "facecolors": "none", "edgecolors": colour, "linewidths": 2}
            ring["marker"] = marker
            mean = (spent.mean(), of_name["final_reward"].mean())
            if name in excluded:
                axes.scatter([], [], label=f"{name} (off scale: {_four_digits(mean[1])})", **ring)
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
        _style_axes(axes, *labels)
        axes.yaxis.set_major_formatter(_THOUSANDS)
    legends_beside(figure, panels)
    return figure


def reward_components(components: "pd.DataFrame") -> "Figure":
    """Plot reward components, one panel per component (column), one bar per controller or rule (row).

    Bars to the right of 0 are rewards, to the left penalties. Each panel has its own scale, since components
    may be unweighted and then do not add up. Components that are 0 in every row are left out.
    """
    nothing = components.round(12).eq(0).all()  # sums of rewards may leave 1e-17
    if not nothing.all():
        components = components.loc[:, ~nothing]
    names, places = [wrapped_name(str(name)) for name in components.index], np.arange(len(components))
    longest = max(len(line) for name in names for line in name.split("\n"))
    across = min(len(components.columns), 2 if longest > NAME_LENGTH // 2 else 3)
    down = -(-len(components.columns) // across)
    figure = _figure(down * (1.0 + rows_height(names)))
    panels = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
    for axes, name in zip(panels, components.columns, strict=False):
        axes.barh(places, components[name], height=0.6, color="#4477AA")
        axes.axvline(0, color="0.3", linewidth=0.8)
        axes.locator_params(axis="x", nbins=4)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
        _style_axes(axes, str(name), "")
    for spare in panels[len(components.columns) :]:
        spare.remove()
    label_rows(panels[0], names)
    return figure


def _format_steps(axes: "Axes") -> None:
    """Format environment steps along the horizontal axis, with few enough ticks not to overlap."""
    axes.locator_params(axis="x", nbins=6)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")


def _figure(height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(_WIDTH, height), dpi=_DOTS_PER_INCH, layout="constrained")


def _style_axes(axes: "Axes", across: str, upward: str) -> None:
    axes.set_xlabel(across)
    axes.set_ylabel(upward)
    axes.grid(alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _four_digits(value: float) -> str:
    return f"{float(f'{value:.4g}'):,.10g}"

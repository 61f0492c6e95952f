"""Final scores: intervals, profiles, ranks, the expected best of n, and components of the reward."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from headway.stats.plots.labels import (
    NAME_LENGTH,
    label_height,
    label_rows,
    legends_beside,
    rows_height,
    wrapped_name,
)
from headway.stats.plots.limits import bound_bands, outliers
from headway.stats.plots.rules import plot_rules
from headway.stats.plots.style import SHADE, THOUSANDS, four_digits, new_figure, point_markers, style_axes

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from headway.stats.best_of import BestOf

_SHADES = 1.1
"""Sum of the opacities of all bands of a panel, at most."""


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
        wrapped_name(name) + (f"\n(off scale: {four_digits(float(own[0]))})" if name in excluded else "")
        for name, own in zip(names, ends, strict=True)
    ]
    figure = new_figure(0.9 + rows_height(beside) + 0.2 * len(rules))
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
    style_axes(axes, label, "")
    axes.xaxis.set_major_formatter(THOUSANDS)
    if rules:
        legends_beside(figure, [axes])
    return figure


def performance_profiles(
    profiles: "pd.DataFrame", label: str, styles: Mapping[str, Mapping[str, Any]]
) -> "Figure":
    """Plot the frame of `profiles`: the share of runs above each score."""
    figure = new_figure(3.9)
    axes = figure.subplots()
    for controller, profile in profiles.groupby("controller", sort=False):
        name, points = str(controller), profile["threshold"].to_numpy()
        axes.step(points, profile["share"], where="post", label=name, linewidth=1.6, **styles[name])
        ends = (profile["low"].to_numpy(), profile["high"].to_numpy())
        axes.fill_between(points, *ends, step="post", color=styles[name]["color"], alpha=0.15, linewidth=0)
    axes.set_ylim(-0.02, 1.02)
    style_axes(axes, f"{label} above", "share of runs")
    legends_beside(figure, [axes])
    return figure


def rank_diagram(average_ranks: Mapping[str, float], groups: Sequence[tuple[int, int]]) -> "Figure":
    """Plot a critical-difference diagram (Demsar 2006) of controllers, best average rank first.

    `groups`: first and last place in that order of the controllers that a bar joins. The better half of the
    names is at the left of the axis of ranks, the others at the right.
    """
    places = list(average_ranks.values())
    count, left = len(places), (len(places) + 1) // 2
    labels = [wrapped_name(f"{name} ({four_digits(rank)})") for name, rank in average_ranks.items()]
    row = 0.1 + max(label_height(label) for label in labels)
    bars = 0.12 * (len(groups) + 1)
    figure = new_figure(0.6 + bars + row * left)
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
    figure = new_figure(4.2)
    axes = figure.subplots()
    shade = min(SHADE, _SHADES / max(len(curves), 1))
    for name, best in curves.items():
        n = np.arange(1, len(best.mean) + 1)
        axes.plot(n, best.mean, label=name, linewidth=1.6, **point_markers(len(n)), **styles[name])
        axes.fill_between(
            n,
            best.mean - best.std,
            best.mean + best.std,
            color=styles[name]["color"],
            alpha=shade,
            linewidth=0,
        )
    bound_bands(axes, np.concatenate([best.mean for best in curves.values()]))
    axes.locator_params(axis="x", integer=True)
    style_axes(axes, "candidates n", label)
    axes.yaxis.set_major_formatter(THOUSANDS)
    figure.suptitle(title)
    legends_beside(figure, [axes])
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
    figure = new_figure(down * (1.0 + rows_height(names)))
    panels = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
    for axes, name in zip(panels, components.columns, strict=False):
        axes.barh(places, components[name], height=0.6, color="#4477AA")
        axes.axvline(0, color="0.3", linewidth=0.8)
        axes.locator_params(axis="x", nbins=4)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
        style_axes(axes, str(name), "")
    for spare in panels[len(components.columns) :]:
        spare.remove()
    label_rows(panels[0], names)
    return figure

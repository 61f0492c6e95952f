"""Names in plots: legends beside panels, labels of lines and rows; figures grow until they fit."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_PANEL_WIDTH = 5.5
"""Minimum width in inches of a panel next to a legend."""
_AROUND_PANEL = 1.0
"""Height in inches of title, tick labels and label of a panel, at most."""
_LINE_HEIGHT = 0.17
"""Height in inches of a line of text next to an axis."""
NAME_LENGTH = 44
"""Characters per line of a controller's name, which includes its settings."""


def legends_beside(figure: "Figure", panels: Iterable["Axes"]) -> None:
    """Put a legend to the right of each panel and enlarge the figure until all names fit."""
    legends = []
    for axes in panels:
        handles, names = axes.get_legend_handles_labels()
        legends.append(
            axes.legend(
                handles,
                [wrapped_name(name) for name in names],
                fontsize="small",
                loc="center left",
                bbox_to_anchor=(1.01, 0.5),
                frameon=False,
            )
        )
    extents = [legend.get_window_extent() for legend in legends]
    width, height = figure.get_size_inches()
    widest = max(extent.width for extent in extents) / figure.dpi
    highest = max(extent.height for extent in extents) / figure.dpi
    figure.set_size_inches(max(width, _PANEL_WIDTH + widest), max(height, len(legends) * (highest + 0.4)))


def label_ends(figure: "Figure", panels: Sequence["Axes"]) -> None:
    """Label the lines of panels, one above the other, beside their right ends; enlarge the figure to fit.

    Lines without points come last.
    """
    from matplotlib.text import Text  # an annotation's own extent includes its line

    width, height = figure.get_size_inches()
    widest, highest = 0.0, height / len(panels) - _AROUND_PANEL
    for axes in panels:
        names = [wrapped_name(str(line.get_label())) for line in _named_lines(axes)]
        highest = max(highest, sum(map(label_height, names)))
    for axes in panels:
        lines, (bottom, top) = _named_lines(axes), axes.get_ylim()
        names = [wrapped_name(str(line.get_label())) for line in lines]
        ends = [_right_end(axes, line) for line in lines]
        wanted = [min(max((y - bottom) / (top - bottom), 0.0), 1.0) for _, y in ends]
        places = _apart(wanted, [label_height(name) / highest for name in names])
        for line, name, end, place in zip(lines, names, ends, places, strict=True):
            is_shown, colour = bottom <= end[1] <= top, line.get_color()
            connection = {"arrowstyle": "-", "relpos": (0.0, 0.5), "color": colour, "linewidth": 0.6}
            label = axes.annotate(
                name,
                xy=end if is_shown else (1.0, place),
                xycoords="data" if is_shown else "axes fraction",
                xytext=(1.06, place),
                textcoords="axes fraction",
                fontsize="small",
                verticalalignment="center",
                color=colour,
                arrowprops={**connection, "shrinkA": 1, "shrinkB": 0} if is_shown else None,
                annotation_clip=False,
            )
            widest = max(widest, Text.get_window_extent(label).width / figure.dpi)
    figure.set_size_inches(
        max(width, _PANEL_WIDTH + widest), max(height, len(panels) * (highest + _AROUND_PANEL))
    )


def _named_lines(axes: "Axes") -> list["Line2D"]:
    """Return the lines with names, from the one that ends highest to those without points."""
    lines = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
    return sorted(lines, key=lambda line: -_right_end(axes, line)[1])


def _right_end(axes: "Axes", line: "Line2D") -> tuple[float, float]:
    """Return a line's last point; for a horizontal line across the axes, the point at their right edge."""
    across, up = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    known = np.flatnonzero(np.isfinite(up))
    if not len(known):
        return np.inf, -np.inf
    is_rule = line.get_transform() == axes.get_yaxis_transform(which="grid")
    return axes.get_xlim()[1] if is_rule else float(across[known[-1]]), float(up[known[-1]])


def _apart(wanted: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Return the middles of labels, between 0 and 1 and as near as possible to `wanted`, such that none
    overlap.

    `wanted` descends. Isotonic regression by pooling adjacent violators.
    """
    if not wanted:
        return []
    offsets = np.cumsum([0.0, *(0.5 * (one + next_one) for one, next_one in pairwise(heights))])
    pools: list[tuple[float, int]] = []
    for value in np.add(wanted, offsets):
        mean, size = float(value), 1
        while pools and pools[-1][0] < mean:
            before, of_before = pools.pop()
            mean, size = (mean * size + before * of_before) / (size + of_before), size + of_before
        pools.append((mean, size))
    places = np.repeat([mean for mean, _ in pools], [size for _, size in pools])
    places = np.clip(places, offsets[-1] + heights[-1] / 2, 1 - heights[0] / 2) - offsets
    return [float(place) for place in places]


def label_height(name: str) -> float:
    """Return the height in inches of a label beside a line."""
    return 0.02 + _LINE_HEIGHT * (1 + name.count("\n"))


def wrapped_name(name: str) -> str:
    """Break a name into lines of at most `NAME_LENGTH` characters."""
    return "\n".join(wrap(name, NAME_LENGTH))


def label_rows(axes: "Axes", names: Sequence[str]) -> None:
    """Label the rows of a vertical axis from the top; names may have several lines."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)


def rows_height(names: Iterable[str]) -> float:
    """Return the height in inches of rows with these names."""
    return sum(max(0.36, 0.08 + _LINE_HEIGHT * (1 + name.count("\n"))) for name in names)

"""Colours, lines and markers, and the look of figures and axes."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9",
    "#882255", "#999933", "#332288", "#117733",
)  # fmt: skip
LINE_STYLES: tuple[Any, ...] = ("-", (0, (5, 1)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (5, 1, 1, 1, 1, 1)))
"""Line styles of the first to the fifth round through the colours."""
MARKERS = ("o", "s", "^", "D", "v")
"""Markers of the same rounds in scatter plots."""
_MAX_MARKED_POINTS = 60
"""Lines with at most this number of points have a marker at each point."""
THOUSANDS = "{x:,.10g}"
"""Tick format with thousands separators, for matplotlib."""
_WIDTH = 9.0
_DOTS_PER_INCH = 150
SHADE = 0.18
"""Opacity of the band of an interval."""


def colours(controllers: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the style (colour and line) of each controller, for matplotlib.

    After ten controllers the colours repeat with another line style.
    """
    return {
        name: {
            "color": COLOURS[place % len(COLOURS)],
            "linestyle": LINE_STYLES[place // len(COLOURS) % len(LINE_STYLES)],
        }
        for place, name in enumerate(controllers)
    }


def point_markers(points: int) -> dict[str, Any]:
    """Return markers for short curves, so that a line between two points does not look like a dense curve."""
    return {"marker": "o", "markersize": 3.5} if points <= _MAX_MARKED_POINTS else {}


def new_figure(height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(_WIDTH, height), dpi=_DOTS_PER_INCH, layout="constrained")


def style_axes(axes: "Axes", across: str, upward: str) -> None:
    axes.set_xlabel(across)
    axes.set_ylabel(upward)
    axes.grid(alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def format_steps(axes: "Axes") -> None:
    """Format environment steps along the horizontal axis, with few enough ticks not to overlap."""
    axes.locator_params(axis="x", nbins=6)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")


def four_digits(value: float) -> str:
    return f"{float(f'{value:.4g}'):,.10g}"

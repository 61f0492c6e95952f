"""Lines of classical rules: their styles, and those near enough to learners to be drawn."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

from headway.stats.plots.limits import OUTLIER_FACTOR, extend_axis
from headway.stats.plots.style import four_digits

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
        if distance(rule) > OUTLIER_FACTOR * (high - low):
            break
        near.add(rule)
        low, high = min(low, rules[rule]), max(high, rules[rule])
    return near


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
    lowest if -1. A vertical axis with fixed limits is extended to the plotted rules.
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
            axes.plot([], [], label=f"{name} (off scale: {four_digits(value)})", **style)
    if not upright and not axes.get_autoscaley_on():
        extend_axis(axes, [rules[rule] for rule in near])

"""Numbers as text: with their deviation or interval, to the digits that these support."""

import math
from collections.abc import Iterable

MISSING = "\N{EN DASH}"
_DIGITS = 4


def formatted(value: float | None, decimals: int | None = None, sign: str = "") -> str:
    """Format a number to `decimals`, or to four significant digits, whole parts in full; a dash if unknown.

    `sign` is "+" to write that of positive numbers and of zero; zero is never negative.
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if decimals is not None:
        return f"{round(value, decimals):{sign}z,.{max(decimals, 0)}f}"
    if value == int(value) and abs(value) < 1e15:
        return f"{int(value):{sign},}"
    if abs(value) < 1e-4:
        return f"{value:{sign}.{_DIGITS - 1}e}"
    return formatted(value, max(_DIGITS - 1 - math.floor(math.log10(abs(value))), 0), sign)


def with_deviation(mean: float, deviation: float, decimals: int | None = None) -> str:
    """Format as `71.28 ± 0.15`, or without the deviation if it is unknown."""
    if not math.isfinite(mean):
        return MISSING
    if decimals is None:
        decimals = _decimals(deviation if math.isfinite(deviation) else 0.0, mean)
    if not math.isfinite(deviation):
        return formatted(mean, decimals)
    return f"{formatted(mean, decimals)} ± {formatted(deviation, decimals)}"


def with_interval(estimate: float, low: float, high: float, sign: str = "") -> str:
    """Format as `20.5 [15.4, 25.7]`, or without the interval if it is unknown; `sign`: of `formatted`."""
    if not math.isfinite(estimate):
        return MISSING
    if not (math.isfinite(low) and math.isfinite(high)):
        return formatted(estimate, _decimals(0.0, estimate), sign)
    decimals = with_ends(_decimals(high - low, estimate), (low, high))
    return f"{formatted(estimate, decimals, sign)} [{formatted(low, decimals)}, {formatted(high, decimals)}]"


def with_ends(decimals: int, ends: Iterable[float]) -> int:
    """Return the decimals, at least `decimals`, with which none of the ends of intervals is rounded to 0.

    An end of 0 hides whether the interval excludes 0. At most three more; the end may be 0 itself.
    """
    shown = [abs(end) for end in ends if end]
    return next(
        (more for more in range(decimals, decimals + 3) if all(round(end, more) for end in shown)),
        decimals + 3,
    )


def scale_of(largest: float, unit: str) -> tuple[str, float]:
    """Return a readable unit for values up to `largest` and the factor to it: (`mWh`, 1e6) for 3e-5 kWh.

    `unit` must begin with k.
    """
    base = unit.removeprefix("k")
    for prefix, factor in (("k", 1.0), ("", 1e3), ("m", 1e6)):
        if largest * factor >= 1:
            return prefix + base, factor
    return "m" + base, 1e6


def _decimals(spread: float, value: float) -> int:
    """Return the number of decimals: two digits of the spread, at most four digits in all; below 1,000 at
    least one."""
    largest = max(abs(value), spread)
    four_digits = 3 - math.floor(math.log10(largest)) if largest else 0
    decimals = min(1 - math.floor(math.log10(spread)), four_digits) if spread > 0 else four_digits
    return min(max(decimals, int(largest < 1e3)), 9)

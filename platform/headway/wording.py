"""Wording shared by all printed output."""

import re
from collections.abc import Sequence

_UNITS = {
    "minutes": ("min", "min"),
    "s": ("s", "s"),
    "m": ("m", "m"),
    "m/s": ("m/s", "ms"),
    "m/s^2": ("m/s\N{SUPERSCRIPT TWO}", "ms2"),
    "per hour": ("per hour", "vph"),
    "gallons/s": ("gallons/s", "gal_s"),
}
"""Unit as displayed, and its form in metric names, by the unit that ends a metric's description."""


def counted(count: int, what: str) -> str:
    """Return a count with its noun: `1 run`, `3 runs`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def spans(numbers: Sequence[int]) -> str:
    """Return ascending numbers as text, three or more consecutive ones shortened to a range: `0..3,7`."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ",".join(f"{part[0]}..{part[-1]}" if len(part) > 2 else ",".join(map(str, part)) for part in parts)


def environment_name(env_id: str) -> str:
    """Return an environment's id, or the name of its file: `shuttle.py` for `/lab/shuttle.py`."""
    return env_id.rpartition("/")[2] if env_id.endswith(".py") else env_id


def readable_metric(metric: str, description: str) -> str:
    """Return a metric's name in words, with its unit if it has one: `mean wait, min` for `mean_wait_min`.

    The unit stands in the description after its last comma, up to a semicolon.
    """
    known = _UNITS.get(description.partition(";")[0].rpartition(", ")[2])
    if known is None:
        return metric.replace("_", " ")
    unit, short = known
    name = re.sub(f"_{short}(?=_|$)", "", metric).replace("_", " ")
    return f"{name}, {unit}"

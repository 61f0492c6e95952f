"""Checks for the values of configuration records."""

from math import isfinite


def require(holds: bool, message: str) -> None:
    """Raise ValueError with `message` unless `holds`."""
    if not holds:
        raise ValueError(message)


def require_finite(record: object) -> None:
    """Raise ValueError naming the first of a record's numbers that is infinite or NaN."""
    for name, value in vars(record).items():
        require(not isinstance(value, float) or isfinite(value), f"{name} must be finite, not {value}")


def require_at_least(low: float, **values: float) -> None:
    """Raise ValueError naming the first of `values` that is below `low` or NaN."""
    for name, value in values.items():
        require(value >= low, f"{name} must be at least {low:g}, not {value:g}")

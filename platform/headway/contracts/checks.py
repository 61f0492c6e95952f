"""Checks for the values of configuration records."""


def require(holds: bool, message: str) -> None:
    """Raise ValueError with `message` unless `holds`."""
    if not holds:
        raise ValueError(message)


def require_at_least(low: float, **values: float) -> None:
    """Raise ValueError naming the first of `values` that is below `low` or NaN."""
    for name, value in values.items():
        require(value >= low, f"{name} must be at least {low:g}, not {value:g}")

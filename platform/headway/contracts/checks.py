"""What every config checks of its values."""


def require(holds: bool, message: str) -> None:
    """Raise ValueError with `message` unless it holds."""
    if not holds:
        raise ValueError(message)


def require_at_least(low: float, **values: float) -> None:
    """Raise ValueError naming the first value that is below `low`, or is not a number."""
    for name, value in values.items():
        require(value >= low, f"{name} must be at least {low:g}, not {value:g}")

"""Checks for the values of configuration records."""

import textwrap
from math import isfinite
from operator import attrgetter

from headway.contracts.errors import InvalidValueError

_MAX_LENGTH = 60


def shown(value: object) -> str:
    """Return a value as YAML writes it, shortened for a message."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value) if isinstance(value, str) else str(value)
    return textwrap.shorten(text, _MAX_LENGTH, placeholder="...")


def require(holds: bool, message: str) -> None:
    """Raise ValueError with `message`, about several keys, unless `holds`."""
    if not holds:
        raise ValueError(message)


def require_key(holds: bool, key: str, problem: str) -> None:
    """Raise InvalidValueError with `key` and `problem` unless `holds`."""
    if not holds:
        raise InvalidValueError(key, problem)


def require_value(record: object, key: str, holds: bool, rule: str) -> None:
    """Raise InvalidValueError with `key`, `rule` and the record's value unless `holds`.

    `rule`: such as "must be above 0". Dots in `key` lead into nested records.
    """
    if not holds:
        raise InvalidValueError(key, f"{rule}, not {shown(attrgetter(key)(record))}")


def require_default(record: object, key: str, unless: bool, problem: str) -> None:
    """Raise InvalidValueError with `key` and `problem` if the record's value is not the default of its class.

    `unless`: the key has an effect, so that it may have any value.
    """
    require_key(unless or getattr(record, key) == getattr(type(record), key), key, problem)


def require_finite(record: object) -> None:
    """Raise InvalidValueError for the first of a record's numbers that is infinite or NaN."""
    for key, value in vars(record).items():
        require_value(record, key, not isinstance(value, float) or isfinite(value), "must be finite")


def require_at_least(low: float, **values: float) -> None:
    """Raise InvalidValueError for the first of `values` that is below `low` or NaN."""
    for key, value in values.items():
        require_key(value >= low, key, f"must be at least {low:g}, not {value:g}")

"""Values of options that several data commands share: seeds, day types, dates and lists of names."""

import datetime as dt
from typing import TYPE_CHECKING, Literal

from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from headway_envs.bus.scenario.tables import Tables


def require_seed(seed: int) -> None:
    """Raise HeadwayError if the value of `--seed` is negative."""
    if seed < 0:
        raise HeadwayError(f"--seed must be at least 0, not {seed}")


def day_type_of(
    tables: "Tables", wanted: Literal["weekday", "sunday"] | None
) -> Literal["weekday", "sunday"]:
    """Return the value of `--day-type`; default: weekday if it has trips, else Sunday."""
    there = set(tables.trips["daytype"])
    return wanted or ("weekday" if "weekday" in there else "sunday")


def date_of(day: str, text: str | None) -> dt.date | None:
    """Return the date given by `--DAY`, or None. Raises HeadwayError if it is not a date."""
    if text is None:
        return None
    try:
        return dt.date.fromisoformat(text)
    except ValueError as error:
        raise HeadwayError(f"--{day}: '{text}' is not a date YYYY-MM-DD") from error


def names_of(text: str | None) -> tuple[str, ...]:
    """Return comma-separated names."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())

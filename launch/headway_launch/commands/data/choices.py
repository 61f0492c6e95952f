"""Parsing of options shared by importers: dates and lists of names."""

import datetime as dt

from headway.contracts.errors import HeadwayError


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

"""Options that importers share: dates and lists of names."""

import datetime as dt

from headway.contracts.errors import HeadwayError


def date_of(day: str, text: str | None) -> dt.date | None:
    """The date given by `--DAY`. Raises HeadwayError if it is none."""
    if text is None:
        return None
    try:
        return dt.date.fromisoformat(text)
    except ValueError as error:
        raise HeadwayError(f"--{day}: '{text}' is no date YYYY-MM-DD") from error


def names_of(text: str | None) -> tuple[str, ...]:
    """Names between commas."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())

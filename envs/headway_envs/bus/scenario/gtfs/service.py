"""Service days of a feed: the trips that run on each date."""

import datetime as dt
from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.gtfs.feed import Feed

_DAYS = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
_ADDED = "1"
"""Value of exception_type for service that is added on a date."""
DAYS_OF = {"weekday": (0, 1, 2, 3, 4), "sunday": (6,)}
"""Days of the week per day type; 0 is Monday."""


def chosen_days(
    feed: Feed, trips: pd.DataFrame, wanted: Mapping[str, dt.date | None]
) -> dict[str, tuple[dt.date, set[str]]]:
    """Return, for each day type with service, a date and the services on it.

    The date is the wanted one, or the earliest of the dates with the most trips. Raises HeadwayError if a
    wanted date has no trips or another day type, or if there is no service at all.
    """
    dates, services, runs = _service(feed)
    counts = trips["service_id"].value_counts().reindex(services).fillna(0.0).to_numpy(np.float64)
    by_date = runs @ counts
    weekdays = np.array([date.weekday() for date in dates])
    found: dict[str, tuple[dt.date, set[str]]] = {}
    for day, date in wanted.items():
        own = np.isin(weekdays, DAYS_OF[day])
        if date is not None:
            own &= np.array([other == date for other in dates])
            if date.weekday() not in DAYS_OF[day]:
                raise HeadwayError(f"--{day}: {date} is a {_DAYS[date.weekday()]}; give a date of a {day}")
        load = np.where(own, by_date, 0.0)
        if not load.any():
            if date is not None:
                raise HeadwayError(
                    f"--{day}: no trip runs on {date}; the feed's days are {dates[0]} to {dates[-1]}"
                )
            continue
        best = int(np.argmax(load))
        found[day] = dates[best], {services[i] for i in np.flatnonzero(runs[best])}
    if not found:
        raise HeadwayError(
            f"{feed.path}: no trip runs on any weekday or sunday from {dates[0]} to {dates[-1]}"
        )
    return found


def _service(feed: Feed) -> tuple[list[dt.date], list[str], NDArray[np.bool_]]:
    """Return dates (D), services (V), and which services run on which date (D, V)."""
    calendar, exceptions = feed["calendar"], feed["calendar_dates"]
    begin = _dates("calendar", "start_date", calendar["start_date"])
    end = _dates("calendar", "end_date", calendar["end_date"])
    changed = _dates("calendar_dates", "date", exceptions["date"])
    every = [*begin, *end, *changed]
    first, last = min(every), max(every)
    if (last - first).days > 20_000:
        raise HeadwayError(f"{feed.path}: its dates span {first} to {last}; correct the wrong ones")
    dates = [first + dt.timedelta(days=n) for n in range((last - first).days + 1)]
    for name, frame in (("calendar", calendar), ("calendar_dates", exceptions)):
        if frame["service_id"].isna().any():
            row = frame.index[frame["service_id"].isna()][0]
            raise HeadwayError(f"{name}.txt, line {row + 2}: service_id is blank; name the service")
    services = sorted({*calendar["service_id"], *exceptions["service_id"]})
    place = {service: i for i, service in enumerate(services)}
    runs = np.zeros((len(dates), len(services)), np.bool_)
    weekday = np.array([date.weekday() for date in dates])
    on = (calendar[list(_DAYS)] == "1").to_numpy(np.bool_)
    for row, service in enumerate(calendar["service_id"]):
        inside = slice((begin[row] - first).days, (end[row] - first).days + 1)
        runs[inside, place[service]] |= on[row, weekday[inside]]
    for date, service, kind in zip(
        changed, exceptions["service_id"], exceptions["exception_type"], strict=True
    ):
        runs[(date - first).days, place[service]] = kind == _ADDED
    return dates, services, runs


def _dates(file: str, column: str, texts: "pd.Series[str]") -> list[dt.date]:
    """Return texts YYYYMMDD as dates. Raises HeadwayError naming the line of any other text."""
    found = []
    for row, text in enumerate(texts):
        try:
            found.append(dt.datetime.strptime(str(text), "%Y%m%d").date())
        except ValueError as error:
            raise HeadwayError(
                f"{file}.txt, line {row + 2}, {column}: '{text}' is not a date YYYYMMDD"
            ) from error
    return found

"""CSV files of an operator: their columns, and their rows as data frames of checked values."""

import csv
import difflib
import io
import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.tables import DAY_TYPES


@dataclass(frozen=True)
class Column:
    """Kind and range of a column's values."""

    kind: Literal["text", "day type", "date", "time", "number", "whole number"] = "text"
    optional: bool = False
    """Whether the column may be absent and its cells blank; values are then missing."""
    low: float = 0.0
    high: float = 1e6


_DAY_TYPE = Column("day type", optional=True)
_TRIP = {"line": Column(), "direction": Column()}
_CALL = {**_TRIP, "stop": Column(), "position": Column("whole number", optional=True, low=1, high=1000)}
FILES: Mapping[str, Mapping[str, Column]] = {
    "stops": {
        "stop": Column(),
        "lat": Column("number", low=-90, high=90),
        "lon": Column("number", low=-180, high=180),
    },
    "lines": {**_TRIP, "stop": Column(), "distance_m": Column("number", optional=True)},
    "trips": {
        "day_type": _DAY_TYPE,
        **_TRIP,
        "departure": Column("time"),
        "arrival": Column("time"),
        "vehicle": Column(optional=True),
    },
    "link_times": {
        "day_type": _DAY_TYPE,
        "from_stop": Column(),
        "to_stop": Column(),
        "hour": Column("whole number", high=30),
        "mean_s": Column("number", low=1, high=7200),
        "sd_s": Column("number", optional=True, high=7200),
    },
    "demand": {
        "day_type": _DAY_TYPE,
        **_CALL,
        "hour": Column("whole number", high=30),
        "boardings": Column("number"),
        "alightings": Column("number", optional=True),
        "to_stop": Column(optional=True),
    },
    "calls": {
        "date": Column("date"),
        "trip": Column(),
        "vehicle": Column(optional=True),
        **_CALL,
        "arrival": Column("time", optional=True),
        "departure": Column("time", optional=True),
        "boardings": Column("number", optional=True),
        "alightings": Column("number", optional=True),
    },
}
"""Columns of each file NAME.csv; docs/howto/scenario.md describes them."""
SOURCE_PREFIX = "CSV files of"
"""Beginning of `source` in the metadata of a scenario made from such files."""
_TIME = r"(\d{1,2}):([0-5]\d)(?::([0-5]\d))?"
_LATEST_S = 48 * 3600.0
_WANTED = {
    "date": "a date YYYY-MM-DD",
    "time": "a time HH:MM or HH:MM:SS of 24 hours",
    "number": "a number",
    "whole number": "a whole number",
}


def is_there(folder: Path, name: str) -> bool:
    """Return whether the folder holds NAME.csv."""
    return (folder / f"{name}.csv").exists()


def read_file(folder: Path, name: str) -> pd.DataFrame:
    """Return the columns `FILES[name]` of NAME.csv; the index holds the row numbers of a spreadsheet.

    Times are s after midnight, day types default to weekday, other missing values are None or NaN. Raises
    HeadwayError naming file, row and column.
    """
    texts, separator = read_texts(folder / f"{name}.csv")
    columns = FILES[name]
    _check_names(name, list(texts.columns), columns)
    frame = pd.DataFrame(index=texts.index)
    for column, expected in columns.items():
        text = texts[column] if column in texts else pd.Series("", index=texts.index, dtype="str")
        blank = text == ""
        if not expected.optional:
            refuse(name, texts, column, blank, "is blank; fill it in")
        frame[column] = _values(text, blank, expected, separator)
        wanted = _WANTED.get(expected.kind)
        if wanted:
            wrong = frame[column].isna() & ~blank
            refuse(name, texts, column, wrong, f"is not {wanted}; correct it")
        if expected.kind == "time":
            refuse(name, frame, column, frame[column] > _LATEST_S, "is after 48:00; correct it")
        if "number" in expected.kind:
            outside = (frame[column] < expected.low) | (frame[column] > expected.high)
            limits = f"lies outside {expected.low:g} to {expected.high:g}; correct it"
            refuse(name, texts, column, outside, limits)
        if expected.kind == "day type":
            refuse(
                name, frame, column, ~frame[column].isin(DAY_TYPES), "is not weekday or sunday; correct it"
            )
    return frame


def refuse(
    name: str, frame: pd.DataFrame, column: str, bad: "pd.Series[bool] | NDArray[Any]", problem: str
) -> None:
    """Raise HeadwayError naming file, row, column and value of the first row where `bad`, if any."""
    places = np.flatnonzero(bad)
    if not len(places):
        return
    value = frame[column].iloc[places[0]]
    blank = pd.isna(value) or value == ""
    if FILES[name][column].kind == "time" and not blank and not isinstance(value, str):
        value = f"{int(value) // 3600:02d}:{int(value) % 3600 // 60:02d}:{int(value) % 60:02d}"
    shown = "" if blank else f"'{value}' "
    raise HeadwayError(f"{name}.csv, row {frame.index[places[0]]}, column {column}: {shown}{problem}")


def refuse_repeated(name: str, frame: pd.DataFrame, keys: list[str], column: str, problem: str) -> None:
    """Raise HeadwayError at the first row whose `keys` repeat those of an earlier row."""
    refuse(name, frame, column, frame.duplicated(keys), problem)


def read_texts(path: Path) -> tuple[pd.DataFrame, str]:
    """Return the cells of a file as text, stripped, and its separator, a comma or semicolon.

    The index holds the row numbers of a spreadsheet. Raises HeadwayError for a file that is no such table.
    """
    if not path.is_file():
        others = [file.name for file in path.parent.glob("*.csv") if file.stem not in FILES]
        near = difflib.get_close_matches(path.name, others, 1)
        hint = f" (rename {near[0]}?)" if near else ""
        instead = ", or calls.csv with recorded calls" if path.stem == "trips" else ""
        raise HeadwayError(f"{path} is missing: write it{hint}{instead}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise HeadwayError(f"{path} cannot be read ({error.strerror}); replace it") from error
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    header = text.partition("\n")[0]
    separator = ";" if header.count(";") > header.count(",") else ","
    if not text.strip():
        raise HeadwayError(f"{path.name} is empty: write a heading and rows")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # rows longer than the heading
            frame = pd.read_csv(
                io.StringIO(text),
                sep=separator,
                dtype="str",
                na_filter=False,
                index_col=False,
                skip_blank_lines=False,
            )
    except (ValueError, pd.errors.ParserWarning) as error:
        raise HeadwayError(f"{path.name}{_fault(text, separator, error)}") from error
    frame.columns = frame.columns.str.strip()
    frame.index += 2  # as a spreadsheet counts them, below the heading
    frame = frame.fillna("").apply(lambda column: column.str.strip())
    frame = frame[(frame != "").any(axis=1)]
    if frame.empty:
        raise HeadwayError(f"{path.name} has no rows below its heading: write some")
    return frame, separator


def _fault(text: str, separator: str, error: Exception) -> str:
    """Return the row and the fault of a text that pandas refuses with `error`: too many cells, an open
    quotation, or what pandas says."""
    rows = csv.reader(io.StringIO(text, newline=None), delimiter=separator)
    with suppress(csv.Error):  # a quotation longer than its limit
        width = len(next(rows))
        for number, row in enumerate(rows, 2):
            if len(row) > width:
                cells = f"{len(row)} cells separated by '{separator}'"
                return f", row {number}: {cells}, where the heading has {width}; give every row as many"
    said = " ".join(str(error).split())
    still_open = re.search(r"EOF inside string starting at row (\d+)", said)  # counted from 0
    if still_open:
        return f", row {int(still_open[1]) + 1}: a quotation mark is not closed; close or remove it"
    return f" cannot be read ({said}); correct it"


def _check_names(name: str, there: list[str], columns: Mapping[str, Column]) -> None:
    """Raise HeadwayError if a column is missing, or an unknown one resembles an optional one that is."""
    unknown = [column for column in there if column not in columns]
    for column, expected in columns.items():
        if column in there:
            continue
        near = difflib.get_close_matches(column, unknown, 1, 0.8)
        if near or not expected.optional:
            fix = f"rename '{near[0]}'" if near else f"add it; the columns are {', '.join(there)}"
            raise HeadwayError(f"{name}.csv, row 1: there is no column {column}: {fix}")


def _values(
    text: "pd.Series[str]", blank: "pd.Series[bool]", expected: Column, separator: str
) -> "pd.Series[Any]":
    """Return a column's values; NaN where a text is not of the expected kind."""
    if expected.kind == "text":
        return text.where(~blank)
    if expected.kind == "day type":
        return text.where(~blank, "weekday")
    if expected.kind == "date":
        return pd.to_datetime(text, format="%Y-%m-%d", errors="coerce")
    if expected.kind == "time":
        hours, minutes, seconds = (part for _, part in text.str.extract(f"^{_TIME}$").items())
        clock = pd.to_numeric(hours) * 3600.0 + pd.to_numeric(minutes) * 60.0
        return clock + pd.to_numeric(seconds).fillna(0.0)
    # A spreadsheet that separates by semicolons writes decimal commas.
    plain = text.str.replace(",", ".") if separator == ";" else text
    numbers = pd.to_numeric(plain, errors="coerce").astype(np.float64)
    return numbers.where(numbers % 1 == 0) if expected.kind == "whole number" else numbers

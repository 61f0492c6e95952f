"""Scenario format: eight tables and `meta.json`, and the loader that checks them.

Times are seconds after midnight of the service day and may exceed 86,400. Every value of the columns named
here is checked, even if an experiment does not read it. Other columns are kept, but neither read nor checked:
they may contain blanks.
"""

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import HeadwayError
from headway_envs.bus.config import SCENARIOS

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, NDArray[Any]]
"""A table as arrays by column: with them, small synthetic scenarios and their networks need no pandas."""

NO_LINK = 65535
"""Value of `link` at a pattern's first stop, to which no link leads."""

PERIOD_HOURS = (9, 15, 20)
PERIODS = len(PERIOD_HOURS) + 1
"""Number of periods of the day with separate alighting shares: before 9 h, 9-15, 15-20 and after."""

DAY_TYPES = ("weekday", "sunday")

COLUMNS = {
    "stops": ("stop", "lat", "lon"),
    "patterns": ("pattern", "line", "dir", "n_stops"),
    "pattern_stops": ("pattern", "seq0", "stop", "link"),
    "links": ("link", "from_stop", "to_stop", "leg_m"),
    "link_times": ("link", "hour", "log_sigma", "mean_s", "daytype"),
    "demand": ("pattern", "seq0", "hour", "calls", "board", "daytype"),
    "alighting": ("pattern", "seq0", "period", "p_alight"),
    "trips": ("pattern", "vehicle", "dep_s", "arr_s", "daytype"),
}
"""Tables and their required columns. `board`: mean number of passengers who board in that hour of a day;
`p_alight`: share of the load on arrival that alights, in periods before 9 h, 9-15, 15-20 and after."""

_TEXT = {"line", "dir", "daytype"}
_INTEGERS = {
    "stop",
    "pattern",
    "vehicle",
    "link",
    "from_stop",
    "to_stop",
    "seq0",
    "n_stops",
    "hour",
    "period",
}
_RANGES = {
    "lat": (-90.0, 90.0),
    "lon": (-180.0, 180.0),
    "leg_m": (0.0, 1e6),
    "hour": (0.0, 30.0),
    "log_sigma": (0.0, 10.0),
    "mean_s": (0.1, 1e5),
    "calls": (0.0, 1e6),
    "board": (0.0, 1e7),
    "period": (0.0, 3.0),
    "p_alight": (0.0, 1.0),
    "dep_s": (0.0, 180000.0),
    "arr_s": (0.0, 180000.0),
    "n_stops": (2.0, 1000.0),
    "seq0": (0.0, 1000.0),
}
_KEYS = {
    "stops": ("stop",),
    "patterns": ("pattern",),
    "pattern_stops": ("pattern", "seq0"),
    "links": ("link",),
    "link_times": ("link", "hour", "daytype"),
    "demand": ("pattern", "seq0", "hour", "daytype"),
    "alighting": ("pattern", "seq0", "period"),
}
_REFERENCES = (
    ("pattern_stops", "pattern", "patterns", "pattern"),
    ("pattern_stops", "stop", "stops", "stop"),
    ("links", "from_stop", "stops", "stop"),
    ("links", "to_stop", "stops", "stop"),
    ("link_times", "link", "links", "link"),
    ("demand", "pattern", "patterns", "pattern"),
    ("alighting", "pattern", "patterns", "pattern"),
    ("trips", "pattern", "patterns", "pattern"),
)


@dataclass(frozen=True)
class Tables:
    """Tables of a scenario as data frames with the columns of `COLUMNS`."""

    stops: "pd.DataFrame"
    patterns: "pd.DataFrame"
    pattern_stops: "pd.DataFrame"
    links: "pd.DataFrame"
    link_times: "pd.DataFrame"
    demand: "pd.DataFrame"
    alighting: "pd.DataFrame"
    trips: "pd.DataFrame"
    meta: dict[str, Any] = field(default_factory=dict)
    """`source`, `licence`; `service_centres`: list of [lat, lon]; `link_times_include_dwell`: bool; others as
    in docs/formats/scenario.md."""

    def arrays(self) -> dict[str, Columns]:
        """Return the columns of `COLUMNS` as arrays, by table."""
        return {
            name: {column: getattr(self, name)[column].to_numpy() for column in columns}
            for name, columns in COLUMNS.items()
        }


def stack(parts: Sequence[Columns]) -> Columns:
    """Return tables with the same columns as one, the rows of each after those of the one before."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def read_tables(folder: str | Path) -> Tables:
    """Read and check a scenario folder. Raises HeadwayError naming folder, table, row and column."""
    import pandas as pd

    folder = Path(folder)
    if not folder.is_dir():
        near = difflib.get_close_matches(str(folder), SCENARIOS, 1, 0.5)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise HeadwayError(
            f"scenario '{folder}' is none of {', '.join(SCENARIOS)}, and {folder.absolute()} is not a "
            f"folder{hint} (a scenario folder holds eight Parquet tables and meta.json)"
        )
    frames = {}
    for name in COLUMNS:
        path = folder / f"{name}.parquet"
        if not path.is_file():
            raise HeadwayError(f"scenario '{folder}' lacks table {name}: put {name}.parquet there")
        try:
            frames[name] = pd.read_parquet(path)
        except (OSError, ValueError) as error:
            raise HeadwayError(
                f"table {name}: {path} is not a readable Parquet file; write it again ({error})".replace(
                    "\n", " "
                )
            ) from error
    meta_path = folder / "meta.json"
    if not meta_path.is_file():  # a pipe would be waited for
        raise HeadwayError(
            f"{meta_path} is missing or no regular file; it states the source of the tables: write one, at "
            "least {}"
        )
    try:
        meta = json.loads(meta_path.read_text())
    except OSError as error:
        raise HeadwayError(f"{meta_path} cannot be read ({error.strerror}): replace it") from error
    except (ValueError, RecursionError) as error:
        raise HeadwayError(f"{meta_path} is not valid JSON: {error}; correct it") from error
    if not isinstance(meta, dict):
        raise HeadwayError(f"{meta_path} holds no JSON object; write one, at least {{}}")
    tables = Tables(**frames, meta=meta)
    try:
        check_tables(tables)
    except HeadwayError as error:
        raise HeadwayError(f"scenario '{folder}': {error}") from error
    return tables


def write_tables(tables: Tables, folder: str | Path) -> None:
    """Write a scenario folder that `read_tables` can read."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name in COLUMNS:
        getattr(tables, name).to_parquet(folder / f"{name}.parquet", index=False)
    (folder / "meta.json").write_text(json.dumps(tables.meta, indent=1))


def check_tables(tables: Tables) -> None:
    """Raise HeadwayError at the first fault in the tables or metadata.

    Checked are columns, blanks, ranges, duplicates, references and sequences.
    """
    # Errors name rows by their index, which must be their number in the file also after sorting.
    numbered = {name: getattr(tables, name).reset_index(drop=True) for name in COLUMNS}
    tables = replace(tables, **numbered)
    for name, columns in COLUMNS.items():
        frame: pd.DataFrame = getattr(tables, name)
        _check_columns(name, frame, columns)
        if frame.empty:
            raise HeadwayError(f"table {name} has no rows: write at least one")
        for column in columns:
            _check_values(name, frame, column)
        if name in _KEYS:
            repeated = frame.duplicated(list(_KEYS[name])).to_numpy()
            _refuse_rows(name, frame, "+".join(_KEYS[name]), repeated, "repeats an earlier row; keep one")
    for name, column, other, key in _REFERENCES:
        frame = getattr(tables, name)
        missing = ~frame[column].isin(getattr(tables, other)[key]).to_numpy()
        _refuse_rows(name, frame, column, missing, f"is not in table {other}; add it there or drop the row")
    _check_patterns(tables)
    _check_calls(tables)
    _check_meta(tables.meta)
    backwards = (tables.trips["arr_s"] < tables.trips["dep_s"]).to_numpy()
    _refuse_rows("trips", tables.trips, "arr_s", backwards, "is before dep_s; correct the times")


def _refuse_rows(name: str, frame: "pd.DataFrame", column: str, bad: NDArray[np.bool_], what: str) -> None:
    """Raise HeadwayError naming the first row where `bad`, if any."""
    if not bad.any():
        return
    place = int(np.flatnonzero(bad)[0])
    values = [str(frame[part].iloc[place]) for part in column.split("+")]
    raise HeadwayError(f"table {name}, row {frame.index[place]}, column {column}: {', '.join(values)} {what}")


def _check_columns(name: str, frame: "pd.DataFrame", columns: tuple[str, ...]) -> None:
    for column in columns:
        if column not in frame.columns:
            near = difflib.get_close_matches(column, [str(c) for c in frame.columns], 1, 0.5)
            hint = f"; rename '{near[0]}'?" if near else ""
            raise HeadwayError(f"table {name} lacks column {column}: add it{hint}")


def _check_values(name: str, frame: "pd.DataFrame", column: str) -> None:
    import pandas as pd

    _refuse_rows(name, frame, column, frame[column].isna().to_numpy(), "is blank; fill it in")
    if column == "daytype":
        wrong = ~frame[column].isin((*DAY_TYPES, "saturday")).to_numpy()
        _refuse_rows(name, frame, column, wrong, "is not weekday, saturday or sunday; correct it")
    if column in _TEXT:
        empty = (frame[column].astype(str).str.strip() == "").to_numpy()
        _refuse_rows(name, frame, column, empty, "is empty; fill it in")
        return
    if not pd.api.types.is_numeric_dtype(frame[column]):
        raise HeadwayError(f"table {name}, column {column} is not numeric: write numbers")
    low, high = _RANGES.get(column, (0.0, 2.0**53))
    values = frame[column].to_numpy(np.float64)
    outside = ~((values >= low) & (values <= high))
    _refuse_rows(name, frame, column, outside, f"lies outside {low:g} to {high:g}; correct it")
    if column in _INTEGERS:
        _refuse_rows(name, frame, column, values % 1 != 0, "is not a whole number; correct it")


def _check_patterns(tables: Tables) -> None:
    """Check that positions of each pattern run from 0, and that each link leads from the previous stop."""
    calls = tables.pattern_stops.sort_values(["pattern", "seq0"])
    expected = calls.groupby("pattern").cumcount().to_numpy()
    gap = calls["seq0"].to_numpy() != expected
    _refuse_rows("pattern_stops", calls, "seq0", gap, "breaks the sequence 0, 1, 2, ... of its pattern")
    counts = calls.groupby("pattern").size()
    stated = tables.patterns.set_index("pattern")["n_stops"]
    wrong = (counts.reindex(stated.index).fillna(0) != stated).to_numpy()
    _refuse_rows(
        "patterns", tables.patterns, "n_stops", wrong, "is not the pattern's number of pattern_stops"
    )
    inner = calls["seq0"].to_numpy() > 0
    links = tables.links.set_index("link")
    unknown = inner & ~calls["link"].isin(links.index).to_numpy()
    _refuse_rows("pattern_stops", calls, "link", unknown, "is not in table links; add it there")
    before = calls["stop"].shift().to_numpy()
    starts = links["from_stop"].reindex(calls["link"]).to_numpy()
    ends = links["to_stop"].reindex(calls["link"]).to_numpy()
    apart = inner & ((starts != before) | (ends != calls["stop"].to_numpy()))
    _refuse_rows("pattern_stops", calls, "link", apart, "does not lead from the stop before to this one")


def _check_calls(tables: Tables) -> None:
    """Check that demand and alighting refer to existing positions; all passengers alight at the last one."""
    import pandas as pd

    counts = tables.patterns.set_index("pattern")["n_stops"]
    for name in ("demand", "alighting"):
        frame: pd.DataFrame = getattr(tables, name)
        beyond = frame["seq0"].to_numpy() >= counts.reindex(frame["pattern"]).to_numpy()
        _refuse_rows(name, frame, "seq0", beyond, "is beyond the pattern's last stop; drop the row")
    frame = tables.alighting
    last = frame["seq0"].to_numpy() == counts.reindex(frame["pattern"]).to_numpy() - 1
    staying = last & (frame["p_alight"].to_numpy() < 1)
    _refuse_rows("alighting", frame, "p_alight", staying, "is below 1 at the last stop; set it to 1")
    calls = tables.pattern_stops
    periods = frame.groupby(["pattern", "seq0"]).size()
    found = periods.reindex(pd.MultiIndex.from_frame(calls[["pattern", "seq0"]])).to_numpy(np.float64)
    what = f"has not {PERIODS} rows in table alighting, one per period; add them"
    _refuse_rows("pattern_stops", calls, "pattern+seq0", ~(found == PERIODS), what)


def _check_meta(meta: Mapping[str, Any]) -> None:
    dwell = meta.get("link_times_include_dwell", True)
    if not isinstance(dwell, bool):
        raise HeadwayError(f"meta.json: link_times_include_dwell must be true or false, not {dwell!r}")
    centres = meta.get("service_centres")
    if centres is None:
        return
    places = centres if isinstance(centres, list) else [None]
    for place in places:
        if not (isinstance(place, list) and len(place) == 2 and all(map(_is_number, place))):
            raise HeadwayError(
                f"meta.json: service_centres must be a list of [lat, lon]; {place!r} is not one"
            )
        if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0):
            raise HeadwayError(
                f"meta.json: service_centres: {place!r} lies nowhere on Earth; give [lat, lon]"
            )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)

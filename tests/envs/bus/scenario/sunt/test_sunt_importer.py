"""Scenarios from raw files of SUNT: defects are repaired and counted, the real files give known numbers."""

import datetime as dt
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from covering import quick_or_slow
from raw_feeds import STOPS, SUNDAY, WEEKDAY, records, write_raw

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.sunt.importer import SuntOptions, import_sunt
from headway_envs.bus.scenario.tables import Tables, check_tables, read_tables, write_tables

Change = Callable[[pd.DataFrame], pd.DataFrame]
SHARED = Path(__file__).parents[6] / "shared" / "data"


def imported(raw: Path, **options: Any) -> Tables:  # noqa: ANN401 - any of the options
    tables = import_sunt(raw, SuntOptions(**options))
    check_tables(tables)
    return tables


def boards(tables: Tables, kind: str) -> float:
    return float(tables.demand.loc[tables.demand["daytype"] == kind, "board"].sum())


def test_records_become_patterns_trips_and_demand(tmp_path: Path) -> None:
    tables = imported(write_raw(tmp_path, {SUNDAY: records(SUNDAY)}))
    assert tables.patterns[["line", "dir", "n_stops"]].to_numpy().tolist() == [
        ["0007", "I", 6],
        ["0007", "V", 6],
    ]
    assert len(tables.trips) == 20
    assert sorted(tables.trips["vehicle"].unique()) == [0, 1]  # renumbered
    assert tables.trips["dep_s"].min() == 6 * 3600
    assert boards(tables, "sunday") == pytest.approx(20 * 5 * 3.0)
    assert tables.link_times["mean_s"].median() == pytest.approx(60.0, abs=4.0)
    middle = tables.alighting[(tables.alighting["seq0"] == 3) & (tables.alighting["period"] == 1)]
    assert middle["p_alight"].to_numpy() == pytest.approx(0.3, abs=0.1)
    assert tables.meta["licence"].startswith("CC BY 4.0; changed:")
    assert "10.17632/85fdtx3kr5.1" in tables.meta["source"]


def test_a_day_without_fares_takes_the_counts_by_stop(tmp_path: Path) -> None:
    raw = write_raw(tmp_path, {WEEKDAY: records(WEEKDAY, board=0.0, alight=0.0), SUNDAY: records(SUNDAY)})
    tables = imported(raw)
    counted = tables.meta["counted"]
    assert counted["days without fares, not used for demand"] == 1
    # 20 hours a stop at 24 an hour; a stop is called at from 6 to 15 h; none boards where all trips end.
    lost = counted["boardings of a weekday without a call there in that hour, left out"]
    assert boards(tables, "weekday") + lost == pytest.approx(6 * 20 * 24.0)
    assert boards(tables, "weekday") == pytest.approx(6 * 10 * 24.0, rel=0.1)
    assert tables.meta["made_from"]["demand weekday"] == "counts by stop of 1 days, raw counts"
    assert tables.meta["made_from"]["alighting"] == "trip records of 2024-09-15"
    without = imported(write_raw(tmp_path / "b", {WEEKDAY: records(WEEKDAY, board=0.0)}, nodes=False))
    assert without.meta["made_from"]["demand weekday"] == "made up: 47 boardings per trip"
    assert without.meta["made_from"]["alighting"] == "made up from fitted shares"
    assert boards(without, "weekday") == pytest.approx(20 * 47.0)


def cell(column: str, row: int | slice, value: object) -> Change:
    """Return a function that returns records with a value there."""

    def change(frame: pd.DataFrame) -> pd.DataFrame:
        frame = frame.copy()
        frame.iloc[row, frame.columns.get_loc(column)] = value
        return frame

    return change


def late(frame: pd.DataFrame) -> pd.DataFrame:
    times = pd.to_datetime(frame["stop_time"]) + pd.Timedelta(hours=12)
    return frame.assign(stop_time=times.astype(str))


MIDNIGHT = f"{SUNDAY} 00:00:00"
UNEXPANDED = "days whose alightings were not expanded, not used for them"
DEFECTS: dict[str, tuple[Change, dict[str, int]]] = {
    "none": (lambda f: f, {}),
    "twice": (lambda f: pd.concat([f, f.iloc[[3]]]), {"calls given twice, the second left out": 1}),
    "blank": (cell("n-boardings", 0, np.nan), {"boardings blank, taken as 0": 1}),
    "infinite": (cell("n-boardings", 0, np.inf), {"boardings infinite, taken as 0": 1}),
    "negative": (cell("n-boardings", 0, -2.0), {"boardings below 0, taken as 0": 1}),
    "fraction": (cell("n-boardings", 0, 1.49), {"fractional boardings (expanded), kept": 1}),
    "full": (cell("loading", 2, 295.0), {"loads above 150, not used": 1}),
    "below": (cell("loading", 2, -3.0), {"loads below 0, not used": 1}),
    "backwards": (
        cell("stop_time", 2, MIDNIGHT),
        {"times before the previous call's, set to it": 1, "link times of 0 s, not used": 1},
    ),
    "timeless": (cell("stop_time", 2, None), {"calls without a time, left out": 1}),
    "still": (cell("stop_time", slice(STOPS), MIDNIGHT), {"trips that end when they begin, left out": 1}),
    "lonely": (lambda f: f.drop(index=range(1, STOPS)), {"trips of one call, left out": 1}),
    "placeless": (cell("stop_id", 2, 1), {"calls at stops without a place, left out": 1}),
    "slow": (cell("stop_time", 5, f"{SUNDAY} 08:00:00"), {"link times above 1800 s, not used": 1}),
    "unexpanded": (lambda f: f.assign(**{"n-alighting": 0.7 * f["n-alighting"]}), {UNEXPANDED: 1}),
    "one operator": (
        lambda f: f.assign(vehicle="3" + f["vehicle"].str[1:]),
        {"days of one operator only": 1},
    ),
    "skipping": (lambda f: f.drop(index=7), {"trips that lack calls of their pattern, kept as whole": 1}),
    "late": (late, {"calls after midnight, kept as past 24 h": 48}),
}
"""(change of the records, what is counted) by defect of the real files."""


@pytest.mark.parametrize(
    ("change", "counts"),
    quick_or_slow(DEFECTS, "none", "twice", "blank", "full", "backwards", "still", "skipping", "late"),
)
def test_each_defect_is_counted_once_and_gives_a_complete_scenario(
    tmp_path: Path, change: Change, counts: dict[str, int]
) -> None:
    tables = imported(write_raw(tmp_path, {SUNDAY: change(records(SUNDAY))}, nodes=False))
    assert counts.items() <= tables.meta["counted"].items()
    assert bool(counts) == bool(tables.meta["counted"])
    assert np.isfinite(tables.demand["board"]).all()


def test_holidays_have_the_timetable_of_a_sunday_and_dates_can_be_given(tmp_path: Path) -> None:
    holiday, friday = dt.date(2024, 11, 15), dt.date(2024, 11, 22)
    days = {date: records(date, trips) for date, trips in ((holiday, 24), (friday, 20), (SUNDAY, 10))}
    raw = write_raw(tmp_path, days)
    assert imported(raw).meta["dates"] == {"weekday": "2024-11-22", "sunday": "2024-11-15"}
    assert imported(raw, sunday=SUNDAY).meta["dates"]["sunday"] == "2024-09-15"
    with pytest.raises(
        HeadwayError, match="--weekday: 2024-11-15 is not a weekday with trips here; available"
    ):
        imported(raw, weekday=holiday)


def test_wrong_folders_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match="is not a folder"):
        imported(tmp_path / "none")
    with pytest.raises(HeadwayError, match=r"there is no file od-YYYY-MM-DD\.parquet"):
        imported(tmp_path)
    raw = write_raw(tmp_path / "a", {SUNDAY: records(SUNDAY)})
    with pytest.raises(HeadwayError, match="--lines: there is no line 12; the lines are 0007"):
        imported(raw, lines=("12",))
    write_tables(imported(raw), tmp_path / "done")
    with pytest.raises(HeadwayError, match="is a scenario already; use it as it is"):
        imported(tmp_path / "done")
    (raw / "gtfs_bus_topique_02_2024.parquet").unlink()
    (raw / "node_temporal_features_04-03-2024.parquet").unlink()
    with pytest.raises(HeadwayError, match="with coordinates of stops"):
        imported(raw)
    write_raw(raw, {SUNDAY: records(SUNDAY).drop(columns="stop_time")})
    with pytest.raises(HeadwayError, match=r"od-2024-09-15\.parquet lacks column stop_time"):
        imported(raw)
    (raw / "od" / "od-2024-09-15.parquet").write_text("no")
    with pytest.raises(HeadwayError, match="is not a readable Parquet file"):
        imported(raw)


def test_a_file_whose_compressed_data_are_damaged_is_named(tmp_path: Path) -> None:
    """Its schema, at the end of the file, is intact."""
    raw = write_raw(tmp_path, {SUNDAY: records(SUNDAY)})
    [file] = raw.rglob("od-2024-09-15.parquet")
    content = bytearray(file.read_bytes())
    content[4:400] = bytes(396)
    file.write_bytes(content)
    with pytest.raises(HeadwayError, match=r"od-2024-09-15\.parquet is not a readable Parquet file"):
        imported(raw)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("loading", "99999:00:00", "'99999:00:00' is not a number"),
        ("n-boardings", "three", "'three' is not a number"),
        ("stop_time", "1e308", "'1e308' is not a time"),
        ("pt_sequence", float("nan"), "'nan' is not the number of a call"),
        ("pt_sequence", 1e308, "is not the number of a call"),
    ],
)
def test_a_value_of_a_wrong_type_is_named_with_its_row(
    column: str, value: float | str, message: str, tmp_path: Path
) -> None:
    day = records(SUNDAY)
    values = [str(each) for each in day[column]] if isinstance(value, str) else list(day[column])
    values[7] = value
    raw = write_raw(tmp_path, {SUNDAY: day.assign(**{column: values})})
    with pytest.raises(HeadwayError, match=rf"od-2024-09-15\.parquet, row 7, {column}: .*{message}"):
        imported(raw)


@pytest.mark.parametrize(("column", "value"), [("time", "1e308"), ("sobe", "some"), ("lat", "north")])
def test_a_wrong_value_among_counts_by_stop_is_named(column: str, value: str, tmp_path: Path) -> None:
    raw = write_raw(tmp_path, {SUNDAY: records(SUNDAY, board=0.0)})
    file = raw / "node_temporal_features_04-03-2024.parquet"
    counts = pd.read_parquet(file)
    counts.assign(**{column: [value, *counts[column].astype(str)[1:]]}).to_parquet(file)
    with pytest.raises(HeadwayError, match=rf"{file.name}, row 0, {column}: '{value}' is not a"):
        imported(raw)


@pytest.mark.data
def test_the_real_files_give_the_numbers_of_the_prepared_extract() -> None:
    raw, ready = SHARED / "sunt_raw", SHARED / "sunt" / "line1"
    if not raw.is_dir() or not ready.is_dir():
        pytest.skip("SUNT's files ../shared/data/sunt_raw and ../shared/data/sunt/line1 are not there")
    tables, extract = imported(raw, lines=("1211",)), read_tables(ready)
    assert len(tables.trips) == len(extract.trips)
    assert len(tables.stops) == len(extract.stops)
    assert tables.meta["dates"] == {"weekday": "2024-08-26", "sunday": "2024-09-15"}
    mine, theirs = [t.trips.groupby("daytype")["dep_s"].mean() for t in (tables, extract)]
    pd.testing.assert_series_equal(mine, theirs, rtol=1e-6, check_dtype=False)
    own, other = (_mean_seconds(t) for t in (tables, extract))
    both = own.index.intersection(other.index)
    assert len(both) >= 88
    assert np.corrcoef(np.log(own[both]), np.log(other[both]))[0, 1] > 0.97
    assert len(build(tables, BusConfig())[0].slot_line) == len(build(extract, BusConfig())[0].slot_line)


def _mean_seconds(tables: Tables) -> "pd.Series[float]":
    """Return weekday link times from 7 to 18 h, s, by the stop_id of their ends."""
    stops = tables.stops.set_index("stop")["stop_id"].astype(str)
    ends = tables.links.set_index("link")[["from_stop", "to_stop"]]
    times = tables.link_times[
        (tables.link_times["daytype"] == "weekday") & tables.link_times["hour"].between(7, 18)
    ]
    mean = times.groupby("link")["mean_s"].mean()
    names = [(stops[a], stops[b]) for a, b in ends.reindex(mean.index).to_numpy()]
    return pd.Series(mean.to_numpy(), index=pd.MultiIndex.from_tuples(names))

"""Scenario format: written scenarios can be read back, and every fault is named."""

import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.synthetic import generate
from headway_envs.bus.scenario.tables import COLUMNS, Tables, check_tables, read_tables, write_tables

PROJECT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def tables() -> Tables:
    return generate("line", 0)


@pytest.mark.parametrize("size", ["line", "district"])
def test_a_seed_gives_the_same_scenario_and_another_one_another(size: str) -> None:
    first, again, other = (generate(size, seed) for seed in (3, 3, 4))
    for name in COLUMNS:
        pd.testing.assert_frame_equal(getattr(first, name), getattr(again, name))
    for name in ("links", "demand"):
        assert not getattr(first, name).equals(getattr(other, name))


def test_a_line_has_fourteen_buses(tables: Tables) -> None:
    check_tables(tables)
    for seed in range(3):
        assert len(prepare(BusConfig(scenario_seed=seed)).agents) == 14


def test_a_written_scenario_is_the_same_network(tables: Tables, tmp_path: Path) -> None:
    write_tables(tables, tmp_path)
    check_tables(read_tables(tmp_path))
    there, here = prepare(BusConfig(scenario=str(tmp_path))), prepare(BusConfig())
    for mine, theirs in zip(here.network, there.network, strict=True):
        np.testing.assert_allclose(mine, theirs)


def test_a_timetable_is_even_and_its_blocks_can_be_driven() -> None:
    prepared = prepare(BusConfig())
    net = prepared.network
    for p in range(len(net.pattern_calls) - 1):
        departures = net.trip_departure[net.trip_pattern == p]
        gaps = np.diff(departures)
        assert gaps.min() > 0
        assert np.abs(np.diff(gaps)).max() < 0.35 * gaps.max()
    for first, last in zip(net.slot_first[:-1], net.slot_first[1:], strict=True):
        assert np.all(np.diff(net.trip_departure[net.slot_trips[first:last]]) > 0)
    assert sorted(net.slot_trips) == list(range(len(net.trip_pattern)))


@pytest.mark.parametrize(
    ("table", "column", "row", "value", "message"),
    [
        ("demand", "board", 3, -1.0, "table demand, row 3, column board"),
        ("link_times", "daytype", 2, "someday", "row 2, column daytype.*weekday, saturday or sunday"),
        ("pattern_stops", "stop", 5, 9999.0, "row 5, column stop.*not in table stops"),
        ("pattern_stops", "seq0", 5, 99.0, "pattern_stops.*seq0.*breaks the sequence"),
        ("pattern_stops", "link", 5, 77.0 + 500, "does not lead from|not in table links"),
        ("links", "to_stop", 0, 9999.0, "row 0, column to_stop.*not in table stops"),
        ("patterns", "n_stops", 0, 3.0, "column n_stops"),
        ("alighting", "p_alight", 7, 1.5, "row 7, column p_alight.*outside 0 to 1"),
        ("alighting", "pattern", 7, 55.0, "row 7, column pattern.*not in table patterns"),
        ("demand", "seq0", 7, 900.0, "column seq0.*beyond the pattern's last stop"),
        ("link_times", "hour", 4, 7.5, "table link_times, row 4, column hour: 7.5 is not a whole number"),
        ("trips", "arr_s", 4, 1.0, "row 4, column arr_s.*before dep_s"),
        ("trips", "pattern", 4, 55.0, "row 4, column pattern.*not in table patterns"),
        ("trips", "vehicle", 4, 1.5, "row 4, column vehicle: 1.5 is not a whole number"),
        ("stops", "lat", 3, 91.0, "table stops, row 3, column lat: 91.0 lies outside -90 to 90"),
        ("stops", "lon", 3, np.inf, "table stops, row 3, column lon: inf lies outside -180 to 180"),
        ("links", "from_stop", 3, 9999.0, "row 3, column from_stop.*not in table stops"),
        ("link_times", "mean_s", 3, 0.0, "table link_times, row 3, column mean_s: 0.0 lies outside"),
        ("link_times", "link", 3, 9999.0, "table link_times, row 3, column link.*not in table links"),
        ("demand", "hour", 3, 31.0, "table demand, row 3, column hour: 31.0 lies outside 0 to 30"),
        ("demand", "pattern", 3, 55.0, "table demand, row 3, column pattern.*not in table patterns"),
        ("alighting", "period", 3, 4.0, "table alighting, row 3, column period: 4.0 lies outside 0 to 3"),
        ("patterns", "line", 1, " ", "table patterns, row 1, column line:  +is empty; fill it in"),
    ],
)
def test_a_broken_value_is_named(
    tables: Tables, table: str, column: str, row: int, value: object, message: str
) -> None:
    frame = getattr(tables, table).copy()
    frame[column] = frame[column].astype(object)
    frame.iloc[row, frame.columns.get_loc(column)] = value
    if not isinstance(value, str):
        frame[column] = frame[column].astype(float)
    with pytest.raises(HeadwayError, match=message) as error:
        check_tables(replace(tables, **{table: frame}))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("table", "column"), [(table, column) for table, columns in COLUMNS.items() for column in columns]
)
def test_a_blank_in_any_named_column_is_named(tables: Tables, table: str, column: str) -> None:
    frame = getattr(tables, table).iloc[::-1].copy()  # an index that is not the row's number in the file
    blank = frame[column].astype(object)
    blank.iloc[6 if len(frame) > 6 else 1] = None
    frame[column] = blank if column in ("line", "dir", "daytype") else blank.astype(float)
    row = int(np.flatnonzero(frame[column].isna())[0])
    with pytest.raises(HeadwayError, match=f"^table {table}, row {row}, column {column}: .* is blank"):
        check_tables(replace(tables, **{table: frame}))


def test_a_link_with_times_of_the_night_alone_is_named(tables: Tables) -> None:
    """Its rows are complete, but of hours outside the service day: travel times would be NaN."""
    frame = tables.link_times.copy()
    link = frame["link"].iloc[0]
    frame = frame[(frame["link"] != link) | (frame["hour"] == frame["hour"].min())]
    frame.loc[frame["link"] == link, "hour"] = 2
    broken = replace(tables, link_times=frame)
    check_tables(broken)
    with pytest.raises(HeadwayError, match=rf"table link_times has no row of link {link} on .* an hour from"):
        build(broken, BusConfig())


def test_columns_that_are_not_named_may_be_blank_and_change_nothing(tables: Tables, tmp_path: Path) -> None:
    frames = {table: getattr(tables, table).assign(median_s=np.nan, note=None) for table in COLUMNS}
    write_tables(replace(tables, **frames), tmp_path)
    there, here = prepare(BusConfig(scenario=str(tmp_path))), prepare(BusConfig())
    for mine, theirs in zip(here.network, there.network, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        assert np.isfinite(theirs).all()


def test_a_fault_is_named_by_its_row_in_an_unsorted_file(tables: Tables) -> None:
    frame = tables.pattern_stops.iloc[::-1].copy()
    frame.iloc[0, frame.columns.get_loc("seq0")] = 500
    with pytest.raises(HeadwayError, match="table pattern_stops, row 0, column seq0: 500 breaks"):
        check_tables(replace(tables, pattern_stops=frame))


def test_hours_without_trips_are_named_with_those_to_set(tables: Tables) -> None:
    """Also hours long after the last trip, in which no passenger is served."""
    inside = tables.trips["dep_s"].between(7 * 3600.0, 9 * 3600.0, inclusive="left")
    short = replace(tables, trips=tables.trips[inside])
    with pytest.raises(
        HeadwayError, match=r"between 12 and 24 h: set env.args.start_hour=7 env.args.end_hour=10$"
    ):
        build(short, BusConfig(start_hour=12))
    weekdays = replace(short, trips=short.trips[short.trips["daytype"] == "weekday"])
    with pytest.raises(HeadwayError, match=r"of day_type sunday .*: set env.args.day_type=weekday$"):
        build(weekdays, BusConfig(day_type="sunday"))
    for hours, fix in (
        (-4.5, r"set env.args.start_hour=4 env.args.end_hour=\d$"),
        (17.5, r"set env.args.start_hour=24 env.args.end_hour=26$"),
        (20.0, r"correct dep_s, because only 4 to 26 h can be simulated$"),
    ):
        moved = {name: short.trips[name] + hours * 3600.0 for name in ("dep_s", "arr_s")}
        with pytest.raises(HeadwayError, match=fix):
            build(replace(short, trips=short.trips.assign(**moved)), BusConfig())
    config = BusConfig()
    [notice] = Prepared(config, *build(short, config), "").notices
    before, _, end = notice.partition("=")
    assert before.endswith("until the day ends, at 24 h; set env.args.end_hour")
    arrived_h = short.trips["arr_s"].max() / 3600.0
    assert arrived_h <= int(end) < arrived_h + 1.5


def test_other_faults_of_tables_are_named(tables: Tables) -> None:
    for name in ("stops", "patterns", "links", "demand"):
        frame = getattr(tables, name)
        doubled = pd.concat([frame, frame.iloc[[0]]], ignore_index=True)
        with pytest.raises(HeadwayError, match=f"table {name}, row {len(frame)}.*repeats"):
            check_tables(replace(tables, **{name: doubled}))
        with pytest.raises(HeadwayError, match=f"table {name} has no rows"):
            check_tables(replace(tables, **{name: frame.iloc[:0]}))
    renamed = tables.demand.rename(columns={"board": "boards"})
    with pytest.raises(HeadwayError, match=r"demand lacks column board.*rename 'boards'"):
        check_tables(replace(tables, demand=renamed))
    text = tables.demand.assign(board="many")
    with pytest.raises(HeadwayError, match="column board is not numeric"):
        check_tables(replace(tables, demand=text))
    alighting = tables.alighting.assign(p_alight=0.5)
    with pytest.raises(HeadwayError, match="below 1 at the last stop"):
        check_tables(replace(tables, alighting=alighting))


def test_a_call_without_its_shares_of_alighting_is_named(tables: Tables) -> None:
    frame = tables.alighting
    gap = frame[(frame["seq0"] != 7) | (frame["period"] != 2) | (frame["pattern"] != 0)]
    with pytest.raises(
        HeadwayError, match=r"pattern_stops, row 7, column pattern\+seq0: 0, 7 has not 4 rows"
    ):
        check_tables(replace(tables, alighting=gap))


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"link_times_include_dwell": "no"}, "link_times_include_dwell must be true or false, not 'no'"),
        ({"service_centres": "here"}, "service_centres must be a list of"),
        ({"service_centres": [[1.0, 2.0, 3.0]]}, "service_centres must be a list of"),
        ({"service_centres": [[-12.9, "x"]]}, "service_centres must be a list of"),
        ({"service_centres": [[-38.5, -200.0]]}, "lies nowhere on Earth"),
    ],
)
def test_wrong_meta_data_are_named(tables: Tables, meta: dict[str, object], message: str) -> None:
    with pytest.raises(HeadwayError, match=f"^meta.json: .*{message}"):
        check_tables(replace(tables, meta=meta))


def test_the_page_of_the_format_names_every_table_and_column() -> None:
    page = (PROJECT / "docs" / "formats" / "scenario.md").read_text(encoding="utf-8")
    sections = {part.split("\n", 1)[0]: part for part in page.split("\n## ")[1:]}
    tables = {name for name in sections if name.startswith("`")}
    assert tables == {f"`{name}`" for name in COLUMNS}
    for name, columns in COLUMNS.items():
        named = re.findall(r"^\| `(\w+)` \|", sections[f"`{name}`"], re.MULTILINE)
        assert named == list(columns)


def test_faults_of_folders_are_named(tables: Tables, tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match="did you mean 'line'"):
        prepare(BusConfig(scenario="lien"))
    write_tables(tables, tmp_path)
    (tmp_path / "meta.json").unlink()
    with pytest.raises(HeadwayError, match=r"meta\.json is missing"):
        read_tables(tmp_path)
    os.mkfifo(tmp_path / "meta.json")
    with pytest.raises(HeadwayError, match=r"meta\.json is missing or no regular file"):
        read_tables(tmp_path)
    (tmp_path / "meta.json").unlink()
    for meta, line in (
        ("{", "is not valid JSON"), ("[" * 100_000, "is not valid JSON"), ("[]", "holds no JSON object")
    ):  # fmt: skip
        (tmp_path / "meta.json").write_text(meta)
        with pytest.raises(HeadwayError, match=f"meta.json {line}"):
            read_tables(tmp_path)
    (tmp_path / "meta.json").write_text("{}")
    tables.demand.drop(columns="daytype").to_parquet(tmp_path / "demand.parquet")
    with pytest.raises(HeadwayError, match=f"^scenario .{tmp_path}.: table demand lacks column daytype"):
        read_tables(tmp_path)
    (tmp_path / "links.parquet").write_text("no")
    with pytest.raises(HeadwayError, match="table links"):
        read_tables(tmp_path)
    (tmp_path / "links.parquet").unlink()
    with pytest.raises(HeadwayError, match="lacks table links"):
        read_tables(tmp_path)


def test_workers_import_neither_pandas_nor_torch(tmp_path: Path) -> None:
    script = (
        "import pickle, sys, numpy as np\n"
        "from headway_envs.bus.entry import ENTRY\n"
        "assert 'numba' not in sys.modules\n"
        f"prepared = pickle.load(open({str(tmp_path / 'prepared')!r}, 'rb'))\n"
        "env = ENTRY.make(prepared, 1)\n"
        "env.reset(np.zeros(1, np.uint64))\n"
        "env.step(np.ones((1, 14), np.int64))\n"
        "heavy = {'pandas', 'pyarrow', 'torch', 'gymnasium', 'pettingzoo'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    (tmp_path / "prepared").write_bytes(pickle.dumps(prepare(BusConfig())))
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)

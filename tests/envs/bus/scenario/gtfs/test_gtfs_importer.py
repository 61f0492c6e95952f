"""Scenarios from GTFS feeds: all that the standard allows is read correctly, and errors are named."""

import datetime as dt
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from raw_feeds import SMALL, write_gtfs

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.kernel.layout import BIN_S
from headway_envs.bus.scenario.gtfs.importer import GtfsOptions, import_gtfs
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.tables import Tables, check_tables

FeedWriter = Callable[..., Path]
BRT = Path(__file__).parents[6] / "shared" / "data" / "sunt_raw" / "brt_gtfs"

STOPS = "stop_id,stop_lat,stop_lon\n"
TIMES = "trip_id,arrival_time,stop_id,stop_sequence\n"
BOTH_TIMES = "trip_id,arrival_time,departure_time,stop_id,stop_sequence\n"
FREQUENCIES = "trip_id,start_time,end_time,headway_secs\n"
DATES = "service_id,date,exception_type\n"
"""Headings of further files."""


@pytest.fixture
def write_feed(tmp_path: Path) -> FeedWriter:
    """(replaced files; None: left out) -> folder of the small feed."""

    def write(**changed: str | None) -> Path:
        return write_gtfs(tmp_path / "feed", changed)

    return write


def imported(folder: Path, **options: Any) -> Tables:  # noqa: ANN401 - any of the options
    tables = import_gtfs(folder, GtfsOptions(**options))
    check_tables(tables)
    return tables


def calls_of(tables: Tables, way: str) -> pd.DataFrame:
    """Return the stops of the first pattern of a direction, with names."""
    pattern = tables.patterns.loc[tables.patterns["dir"] == way, "pattern"].iloc[0]
    calls = tables.pattern_stops[tables.pattern_stops["pattern"] == pattern]
    return calls.merge(tables.stops[["stop", "name"]], on="stop").sort_values("seq0")


def weekday(frame: pd.DataFrame) -> pd.DataFrame:
    return frame[frame["daytype"] == "weekday"]


def weekday_seconds(tables: Tables, way: str) -> list[float]:
    times = weekday(tables.link_times).set_index("link")["mean_s"]
    return [float(times[link]) for link in calls_of(tables, way)["link"][1:]]


def test_blank_times_are_set_by_distance_and_stations_are_one_stop(write_feed: FeedWriter) -> None:
    tables = imported(write_feed())
    assert calls_of(tables, "I")["name"].tolist() == ["Market", "Mill", "Quay", "Hill"]
    assert calls_of(tables, "V")["name"].tolist() == ["Hill", "Quay", "Market"]
    # 08:01 to 08:09 over 10, 20 and 10 thousandths of a degree.
    np.testing.assert_allclose(weekday_seconds(tables, "I"), [120.0, 240.0, 120.0], rtol=0.01)
    assert tables.meta["counted"]["times blank, set by distance"] == 2


def test_times_pass_midnight_and_other_modes_stay_out(write_feed: FeedWriter) -> None:
    tables = imported(write_feed())
    assert tables.patterns["line"].unique().tolist() == ["1"]
    trips = weekday(tables.trips).sort_values("dep_s")
    assert trips["dep_s"].tolist() == [8 * 3600 + 60, 23 * 3600 + 58 * 60]
    assert trips["arr_s"].tolist() == [8 * 3600 + 9 * 60, 25 * 3600 + 600]
    assert trips["vehicle"].tolist() == [0, 0]  # it waits on the hill all day
    assert tables.trips["daytype"].value_counts().to_dict() == {"weekday": 2, "sunday": 1}
    metro = imported(write_feed(), route_types=("1",))
    assert metro.patterns["line"].tolist() == ["M"]


def test_times_that_restart_at_midnight_are_continued(write_feed: FeedWriter) -> None:
    text = SMALL["stop_times"].replace("24:02:00,24:02:00", "00:02:00,00:02:00")
    tables = imported(write_feed(stop_times=text.replace("25:10:00,25:10:00", "01:10:00,01:10:00")))
    assert tables.meta["counted"]["times after midnight written from 0 h on, 24 h added"] == 2
    written = imported(write_feed(stop_times=SMALL["stop_times"]))
    pd.testing.assert_frame_equal(tables.trips, written.trips)
    pd.testing.assert_frame_equal(tables.link_times, written.link_times)


def test_a_single_midnight_time_does_not_shift_others(write_feed: FeedWriter) -> None:
    text = SMALL["stop_times"].replace("24:02:00,24:02:00", "00:00:00,00:00:00")
    tables = imported(write_feed(stop_times=text.replace("25:10:00,25:10:00", "23:59:30,23:59:30")))
    trips = weekday(tables.trips)
    assert trips["arr_s"].max() == 24 * 3600 - 30


def test_a_trip_that_ends_before_it_begins_is_left_out(write_feed: FeedWriter) -> None:
    text = SMALL["stop_times"].replace("out,08:09:00,08:09:00", "out,07:09:00,07:09:00")
    tables = imported(write_feed(stop_times=text))
    assert tables.meta["counted"]["trips that end before they begin, left out"] == 1
    assert tables.trips["daytype"].value_counts().to_dict() == {"weekday": 1, "sunday": 1}


def test_the_busiest_date_is_chosen_and_exceptions_count(write_feed: FeedWriter) -> None:
    folder = write_feed(calendar_dates=DATES + "rest,20240508,1\nwork,20240509,2\nrest,20240519,2\n")
    tables = imported(folder)
    assert tables.meta["dates"] == {"weekday": "2024-05-08", "sunday": "2024-05-12"}
    assert len(weekday(tables.trips)) == 3
    given = imported(folder, weekday=dt.date(2024, 5, 7))
    assert len(given.trips[given.trips["daytype"] == "weekday"]) == 2
    with pytest.raises(HeadwayError, match="no trip runs on 2024-05-09; the feed's days are 2024-05-06 to"):
        imported(folder, weekday=dt.date(2024, 5, 9))
    with pytest.raises(HeadwayError, match="2024-05-09 is a thursday; give a date of a sunday"):
        imported(folder, sunday=dt.date(2024, 5, 9))


def test_calendar_dates_alone_are_enough(write_feed: FeedWriter) -> None:
    tables = imported(write_feed(calendar=None, calendar_dates=DATES + "work,20240507,1\n"))
    assert tables.meta["dates"] == {"weekday": "2024-05-07"}


def test_frequencies_repeat_a_trip(write_feed: FeedWriter) -> None:
    repeats = FREQUENCIES + "out,06:00:00,07:00:00,600\nout,07:00:00,07:30:00,900\n"
    tables = imported(write_feed(frequencies=repeats))
    out = tables.patterns.loc[tables.patterns["dir"] == "I", "pattern"].iloc[0]
    trips = weekday(tables.trips[tables.trips["pattern"] == out])
    assert (trips["dep_s"] / 60).tolist() == [360, 370, 380, 390, 400, 410, 420, 435]
    assert (trips["arr_s"] - trips["dep_s"]).unique().tolist() == [480.0]
    assert {6, 7, 23} <= set(weekday(tables.link_times)["hour"])
    assert tables.meta["counted"]["departures of frequencies.txt"] == 8


def test_blocks_are_vehicles(write_feed: FeedWriter) -> None:
    blocks = "route_id,service_id,trip_id,block_id\nr1,work,out,b1\nr1,work,back,b2\nr1,rest,sun,b1\n"
    tables = imported(write_feed(trips=blocks))
    assert weekday(tables.trips)["vehicle"].nunique() == 2


def test_a_block_with_overlapping_trips_becomes_several_vehicles(write_feed: FeedWriter) -> None:
    trips, times = "route_id,service_id,trip_id,block_id\n", TIMES
    for trip, block, begin in (("t1", "x", 0), ("t2", "x", 20), ("t3", "x", 30), ("u", "y", 0)):
        trips += f"r1,work,{trip},{block}\n"
        times += f"{trip},08:{begin:02}:00,A,1\n{trip},08:{begin + 20}:00,D,2\n"
    tables = imported(write_feed(trips=trips, stop_times=times))
    assert tables.meta["counted"]["blocks of trips that overlap, chained instead"] == 1
    ordered = tables.trips.sort_values(["vehicle", "dep_s"])
    gaps = ordered["dep_s"] - ordered.groupby("vehicle")["arr_s"].shift()
    assert not (gaps < 0).any()
    fine = imported(write_feed(trips=trips, stop_times=times.replace("08:30:00", "08:40:00")))
    assert "blocks of trips that overlap, chained instead" not in fine.meta["counted"]
    assert fine.trips["vehicle"].tolist() == [0, 0, 0, 1]


def test_equal_times_are_spread_and_falling_ones_left_out(write_feed: FeedWriter) -> None:
    times = (
        BOTH_TIMES + "out,08:00:00,08:00:00,A,1\n"
        "out,08:00:00,08:00:00,B,2\n"
        "out,08:04:00,08:04:00,C1,3\n"
        "out,08:04:00,08:04:00,D,4\n"
        "back,09:00:00,09:00:00,D,1\n"
        "back,08:30:00,08:30:00,C2,2\n"
        "back,09:08:00,09:08:00,A,3\n"
    )
    tables = imported(write_feed(stop_times=times))
    np.testing.assert_allclose(weekday_seconds(tables, "I"), [60.0, 120.0, 60.0], rtol=0.01)
    np.testing.assert_allclose(weekday_seconds(tables, "V"), [120.0, 360.0], rtol=0.01)
    counted = tables.meta["counted"]
    assert counted["times equal to the previous one, spread by distance"] == 2
    assert counted["times before the previous one, set by distance"] == 1


@pytest.mark.parametrize("unit", [1.0, 0.001])
def test_blank_times_follow_the_shape_in_any_unit(write_feed: FeedWriter, unit: float) -> None:
    times = (
        "trip_id,arrival_time,stop_id,stop_sequence,shape_dist_traveled\n"
        f"out,08:00:00,A,1,{7000 * unit}\n"
        f"out,,B,2,{8200 * unit}\n"
        f"out,,C1,3,{10_000 * unit}\n"
        f"out,08:10:00,D,4,{13_000 * unit}\n"
    )
    tables = imported(write_feed(stop_times=times))
    np.testing.assert_allclose(weekday_seconds(tables, "I"), [120.0, 180.0, 300.0], rtol=0.01)


def test_odd_rows_are_left_out_and_counted(write_feed: FeedWriter) -> None:
    times = (
        BOTH_TIMES + "out,08:00:00,08:00:00,A,1\n"
        "out,08:00:00,08:00:00,A,1\n"
        "out,08:02:00,08:02:00,nowhere,2\n"
        "out,08:04:00,08:04:00,C1,3\n"
        "out,08:05:00,08:05:00,C2,4\n"
        "out,08:06:00,08:06:00,D,5\n"
        "back,,,D,1\n"
        "back,09:08:00,09:08:00,A,3\n"
        "sun,09:00:00,09:00:00,A,1\n"
    )
    tables = imported(write_feed(stop_times=times))
    assert calls_of(tables, "I")["name"].tolist() == ["Market", "Quay", "Hill"]
    assert tables.meta["counted"] == {
        "calls at stops without a place, left out": 1,
        "calls given twice, the second left out": 1,
        "calls at the same stop or station in a row, the second left out": 1,
        "trips without a time at an end, left out": 1,
        "trips of fewer than two calls, left out": 1,
    }


def test_a_zip_with_a_folder_inside_a_mark_and_latin_letters_is_read(
    write_feed: FeedWriter, tmp_path: Path
) -> None:
    folder = write_feed()
    with zipfile.ZipFile(tmp_path / "feed.zip", "w") as archive:
        for file in folder.iterdir():
            text = file.read_text().replace("Market", "Praça")
            content = ("\ufeff" + text).encode() if file.stem != "stops" else text.encode("latin-1")
            archive.writestr(f"google/{file.name}", content)
    tables = imported(tmp_path / "feed.zip")
    assert "Praça" in set(tables.stops["name"])
    pd.testing.assert_frame_equal(tables.trips, imported(folder).trips)


def test_demand_is_proportional_to_trips_and_marked_as_synthetic(write_feed: FeedWriter) -> None:
    tables = imported(write_feed(), boardings_per_trip=10.0)
    by_day = tables.demand.groupby("daytype")["board"].sum()
    assert by_day["weekday"] == pytest.approx(2 * 10.0)
    assert by_day["sunday"] == pytest.approx(10.0 * 28.0 / 47.0)
    assert "10 boardings" in tables.meta["made_up"]["demand, alighting"]
    assert "doi 10.17632" in tables.meta["made_up"]["demand, alighting"]


def test_passengers_arrive_when_buses_run(write_feed: FeedWriter) -> None:
    """Most passengers arrive within the time for one or two trips a day, and nearly all for a regular
    service; the rest is due to the environment's interpolation between hours."""
    few = imported(write_feed())
    all_day = write_feed(frequencies=FREQUENCIES + "out,06:00:00,20:00:00,1200\n")
    regular = imported(all_day, lines=("1",))
    for tables, least in ((few, 0.65), (regular, 0.97)):
        stated = weekday(tables.demand)["board"].sum()
        network = build(tables, BusConfig())[0]
        assert least * stated <= network.boarding_rate.sum() * BIN_S <= stated * (1 + 1e-9)
    hours = weekday(few.demand[few.demand["board"] > 0])["hour"]
    assert set(hours) == {6, 7, 22, 23, 24}  # for buses of 08:01 and 23:58
    late = imported(write_feed(frequencies=FREQUENCIES + "out,31:00:00,31:10:00,600\n"))
    out = late.patterns.loc[late.patterns["dir"] == "I", "pattern"].iloc[0]
    own = weekday(late.demand[late.demand["pattern"] == out])
    assert own["board"].sum() == pytest.approx(47.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"stop_times": None}, "has no stop_times.txt"),
        ({"calendar": None}, "neither calendar.txt nor calendar_dates.txt"),
        ({"trips": "route_id,service_id\nr1,work\n"}, "trips.txt has no column trip_id"),
        ({"stops": STOPS}, "stops.txt has no rows"),
        ({"stops": STOPS + "A,north,2\n"}, "stops.txt, line 2, stop_lat: 'north' is not a number"),
        ({"stops": STOPS + "A,95,2\nD,1,1\n"}, "stop A lies nowhere on Earth"),
        ({"routes": "route_id,route_type\nr1,2\n"}, "no route is a bus; its route types are 2"),
        ({"stop_times": TIMES + "out,8h,A,1\n"}, "stop_times.txt, line 2, arrival_time: '8h' is not a time"),
        ({"stop_times": TIMES + "out,08:00:00,A,1\n"}, "no trip of the chosen days has two calls"),
        ({"stop_times": TIMES + "out,8\n"}, "is not a table of comma-separated"),
        (
            {"frequencies": FREQUENCIES + "out,06:00:00,07:00:00,0.001\n"},
            "line 2: headway_secs must be at lea",
        ),
        ({"calendar_dates": DATES + "work,20240507,1\n,20240508,1\n"}, "line 3: service_id is blank; name"),
        ({"calendar_dates": DATES + "work,2024-05-07,1\n"}, "line 2, date: '2024-05-07' is not a date YYYYM"),
    ],
)
def test_broken_feeds_are_one_line(
    write_feed: FeedWriter, changed: dict[str, str | None], message: str
) -> None:
    with pytest.raises(HeadwayError, match=message):
        imported(write_feed(**changed))


def test_other_wrong_feeds_and_lines_are_named(write_feed: FeedWriter, tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match="does not exist; give a GTFS feed"):
        imported(tmp_path / "none.zip")
    (tmp_path / "no.zip").write_text("no")
    with pytest.raises(HeadwayError, match="is not a zip file"):
        imported(tmp_path / "no.zip")
    with pytest.raises(HeadwayError, match="the feed has no line 7; it has 1, "):
        imported(write_feed(), lines=("7",))


def test_a_damaged_zip_is_one_line(write_feed: FeedWriter, tmp_path: Path) -> None:
    path = tmp_path / "feed.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in write_feed().iterdir():
            archive.write(file, file.name)
    whole = path.read_bytes()
    name = whole.index(b"stop_times.txt") + len("stop_times.txt")
    path.write_bytes(whole[: name + 5] + bytes([whole[name + 5] ^ 0xFF]) + whole[name + 6 :])
    with pytest.raises(HeadwayError, match="is a damaged or encrypted zip"):
        imported(path)


def test_a_zip_that_unpacks_to_too_much_is_not_unpacked(
    write_feed: FeedWriter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("headway_envs.bus.scenario.gtfs.feed._MAX_BYTES", 2**30)
    path = tmp_path / "feed.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in write_feed().iterdir():
            archive.write(file, file.name)
    size = (1 << 31).to_bytes(4, "little")
    whole = bytearray(path.read_bytes())
    entry = whole.rindex(b"stop_times.txt") - 46  # in the central directory, which states the sizes
    whole[entry + 24 : entry + 28] = size
    path.write_bytes(whole)
    with pytest.raises(HeadwayError, match="unpacks to 2 GiB, more than 1; leave out what is not needed"):
        imported(path)


def test_a_pipe_in_a_feed_is_not_read(write_feed: FeedWriter) -> None:
    folder = write_feed(agency=None)
    os.mkfifo(folder / "agency.txt")
    with pytest.raises(HeadwayError, match=r"agency\.txt is not a regular file"):
        imported(folder)


def test_a_header_that_is_no_header_is_named(write_feed: FeedWriter) -> None:
    with pytest.raises(HeadwayError, match=r"trips\.txt is not a table of comma-separated values"):
        imported(write_feed(trips="a\rb,c\n1,2\n"))


def test_a_file_that_cannot_be_read_is_named(write_feed: FeedWriter) -> None:
    folder = write_feed(agency=None)
    (folder / "agency.txt").symlink_to("/proc/self/mem")  # a regular file, but not readable at its start
    with pytest.raises(HeadwayError, match=r"agency\.txt cannot be read \(Input/output error\)"):
        imported(folder)


def test_files_of_two_feeds_are_not_mixed(write_feed: FeedWriter, tmp_path: Path) -> None:
    folder = write_feed()
    (folder / "old").mkdir()
    (folder / "old" / "notes.txt").write_text("of last year")
    imported(folder)
    (folder / "old" / "stops.txt").write_text(STOPS + "A,1,1\n")
    with pytest.raises(HeadwayError, match=r"holds old/stops\.txt and stops\.txt; keep a single feed there"):
        imported(folder)
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        for name in ("new/agency.txt", "old/agency.txt"):
            archive.writestr(name, "agency_id\n1\n")
    with pytest.raises(HeadwayError, match=r"holds new/agency\.txt and old/agency\.txt"):
        imported(tmp_path / "two.zip")


@pytest.mark.data
def test_the_real_feed_of_the_brt_is_complete_and_runs() -> None:
    if not BRT.is_dir():
        pytest.skip("the BRT's feed ../shared/data/sunt_raw/brt_gtfs is not there")
    tables = imported(BRT)
    assert sorted(tables.patterns["line"].unique()) == ["B001", "B002"]
    assert len(tables.trips) == 412
    assert tables.meta["counted"] == {"times blank, set by distance": 2089}
    network, lines = build(tables, BusConfig())
    assert lines == ("B001", "B002")
    assert len(network.slot_line) == 21


@pytest.mark.slow
def test_a_city_keeps_all_its_trips(tmp_path: Path) -> None:
    """A quarter of a city: 95 lines with 5,700 trips and 188,100 calls per weekday."""
    rng, patterns, calls, trips = np.random.default_rng(0), 190, 33, 30
    pattern, places = np.repeat(np.arange(patterns), trips), rng.uniform(0, 0.3, (2, 3000))
    ways = np.array([rng.choice(3000, calls, replace=False) for _ in range(patterns)])
    departs = np.tile(5 * 60 + 35 * np.arange(trips), patterns)
    minutes = (departs[:, None] + 2 * np.arange(calls)).ravel()
    times = np.array([f"{minute // 60:02d}:{minute % 60:02d}:00" for minute in range(minutes.max() + 1)])
    names = np.arange(len(pattern)) + 100_000
    feed: dict[str, dict[str, Any]] = {
        "stops": {"stop_id": np.arange(3000), "stop_lat": places[0], "stop_lon": places[1]},
        "routes": {"route_id": np.arange(95), "route_short_name": np.arange(95), "route_type": 3},
        "trips": {
            "route_id": pattern // 2,
            "service_id": "work",
            "trip_id": names,
            "direction_id": pattern % 2,
        },
        "stop_times": {
            "trip_id": np.repeat(names, calls),
            "arrival_time": times[minutes],
            "departure_time": times[minutes],
            "stop_id": ways[pattern].ravel(),
            "stop_sequence": np.tile(np.arange(1, calls + 1), len(pattern)),
        },
    }
    for name, columns in feed.items():
        pd.DataFrame(columns).to_csv(tmp_path / f"{name}.txt", index=False)
    (tmp_path / "calendar.txt").write_text(SMALL["calendar"])
    tables = imported(tmp_path)
    assert (len(tables.patterns), len(tables.trips)) == (190, 5_700)
    assert tables.trips["vehicle"].nunique() < 5_700

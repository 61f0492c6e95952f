"""Scenarios from GTFS feeds: all that the standard allows is read correctly, and errors are named."""

import datetime as dt
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.kernel.layout import BIN_S
from headway_envs.bus.scenario.gtfs.importer import GtfsOptions, import_gtfs
from headway_envs.bus.scenario.network import build
from headway_envs.bus.scenario.tables import Tables, check_tables

FeedWriter = Callable[..., Path]
Files = Mapping[str, str]
BRT = Path(__file__).parents[6] / "shared" / "data" / "sunt_raw" / "brt_gtfs"


def imported(folder: Path, **options: Any) -> Tables:  # noqa: ANN401 - any of the options
    tables = import_gtfs(folder, GtfsOptions(**options))
    check_tables(tables)
    return tables


def calls_of(tables: Tables, way: str) -> pd.DataFrame:
    """Return the stops of the first pattern of a direction, with names."""
    pattern = tables.patterns.loc[tables.patterns["dir"] == way, "pattern"].iloc[0]
    calls = tables.pattern_stops[tables.pattern_stops["pattern"] == pattern]
    return calls.merge(tables.stops[["stop", "name"]], on="stop").sort_values("seq0")


def weekday_seconds(tables: Tables, way: str) -> list[float]:
    times = tables.link_times[tables.link_times["daytype"] == "weekday"].set_index("link")["mean_s"]
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
    trips = tables.trips[tables.trips["daytype"] == "weekday"].sort_values("dep_s")
    assert trips["dep_s"].tolist() == [8 * 3600 + 60, 23 * 3600 + 58 * 60]
    assert trips["arr_s"].tolist() == [8 * 3600 + 9 * 60, 25 * 3600 + 600]
    assert trips["vehicle"].tolist() == [0, 0]  # it waits on the hill all day
    assert tables.trips["daytype"].value_counts().to_dict() == {"weekday": 2, "sunday": 1}
    metro = imported(write_feed(), route_types=("1",))
    assert metro.patterns["line"].tolist() == ["M"]


def test_times_that_restart_at_midnight_are_continued(write_feed: FeedWriter, small: Files) -> None:
    text = small["stop_times"].replace("24:02:00,24:02:00", "00:02:00,00:02:00")
    tables = imported(write_feed(stop_times=text.replace("25:10:00,25:10:00", "01:10:00,01:10:00")))
    assert tables.meta["counted"]["times after midnight written from 0 h on, 24 h added"] == 2
    written = imported(write_feed(stop_times=small["stop_times"]))
    pd.testing.assert_frame_equal(tables.trips, written.trips)
    pd.testing.assert_frame_equal(tables.link_times, written.link_times)


def test_a_single_midnight_time_does_not_shift_others(write_feed: FeedWriter, small: Files) -> None:
    text = small["stop_times"].replace("24:02:00,24:02:00", "00:00:00,00:00:00")
    tables = imported(write_feed(stop_times=text.replace("25:10:00,25:10:00", "23:59:30,23:59:30")))
    trips = tables.trips[tables.trips["daytype"] == "weekday"]
    assert trips["arr_s"].max() == 24 * 3600 - 30


def test_a_trip_that_ends_before_it_begins_is_left_out(write_feed: FeedWriter, small: Files) -> None:
    text = small["stop_times"].replace("out,08:09:00,08:09:00", "out,07:09:00,07:09:00")
    tables = imported(write_feed(stop_times=text))
    assert tables.meta["counted"]["trips that end before they begin, left out"] == 1
    assert tables.trips["daytype"].value_counts().to_dict() == {"weekday": 1, "sunday": 1}


def test_the_busiest_date_is_chosen_and_exceptions_count(write_feed: FeedWriter) -> None:
    folder = write_feed(
        calendar_dates="service_id,date,exception_type\nrest,20240508,1\nwork,20240509,2\nrest,20240519,2\n"
    )
    tables = imported(folder)
    assert tables.meta["dates"] == {"weekday": "2024-05-08", "sunday": "2024-05-12"}
    assert len(tables.trips[tables.trips["daytype"] == "weekday"]) == 3
    given = imported(folder, weekday=dt.date(2024, 5, 7))
    assert len(given.trips[given.trips["daytype"] == "weekday"]) == 2
    with pytest.raises(HeadwayError, match="no trip runs on 2024-05-09; the feed's days are 2024-05-06 to"):
        imported(folder, weekday=dt.date(2024, 5, 9))
    with pytest.raises(HeadwayError, match="2024-05-09 is a thursday; give a date of a sunday"):
        imported(folder, sunday=dt.date(2024, 5, 9))


def test_calendar_dates_alone_are_enough(write_feed: FeedWriter) -> None:
    tables = imported(
        write_feed(calendar=None, calendar_dates="service_id,date,exception_type\nwork,20240507,1\n")
    )
    assert tables.meta["dates"] == {"weekday": "2024-05-07"}


def test_frequencies_repeat_a_trip(write_feed: FeedWriter) -> None:
    tables = imported(
        write_feed(
            frequencies="trip_id,start_time,end_time,headway_secs\n"
            "out,06:00:00,07:00:00,600\nout,07:00:00,07:30:00,900\n"
        )
    )
    out = tables.patterns.loc[tables.patterns["dir"] == "I", "pattern"].iloc[0]
    trips = tables.trips[(tables.trips["pattern"] == out) & (tables.trips["daytype"] == "weekday")]
    assert (trips["dep_s"] / 60).tolist() == [360, 370, 380, 390, 400, 410, 420, 435]
    assert (trips["arr_s"] - trips["dep_s"]).unique().tolist() == [480.0]
    hours = tables.link_times.loc[tables.link_times["daytype"] == "weekday", "hour"]
    assert {6, 7, 23} <= set(hours)
    assert tables.meta["counted"]["departures of frequencies.txt"] == 8


def test_blocks_are_vehicles(write_feed: FeedWriter) -> None:
    tables = imported(
        write_feed(
            trips="route_id,service_id,trip_id,block_id\nr1,work,out,b1\nr1,work,back,b2\nr1,rest,sun,b1\n"
        )
    )
    assert tables.trips[tables.trips["daytype"] == "weekday"]["vehicle"].nunique() == 2


def test_a_block_with_overlapping_trips_becomes_several_vehicles(write_feed: FeedWriter) -> None:
    trips = "route_id,service_id,trip_id,block_id\n" + "".join(
        f"r1,work,{trip},{block}\n" for trip, block in (("t1", "x"), ("t2", "x"), ("t3", "x"), ("u", "y"))
    )
    times = "trip_id,arrival_time,stop_id,stop_sequence\n" + "".join(
        f"{trip},{begin},A,1\n{trip},{end},D,2\n"
        for trip, begin, end in (
            ("t1", "08:00:00", "08:20:00"),
            ("t2", "08:20:00", "08:40:00"),
            ("t3", "08:30:00", "08:50:00"),
            ("u", "08:00:00", "08:20:00"),
        )
    )
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
        "trip_id,arrival_time,departure_time,stop_id,stop_sequence\n"
        "out,08:00:00,08:00:00,A,1\n"
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
        "trip_id,arrival_time,departure_time,stop_id,stop_sequence\n"
        "out,08:00:00,08:00:00,A,1\n"
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
    regular = imported(
        write_feed(frequencies="trip_id,start_time,end_time,headway_secs\nout,06:00:00,20:00:00,1200\n"),
        lines=("1",),
    )
    for tables, least in ((few, 0.65), (regular, 0.97)):
        stated = tables.demand.loc[tables.demand["daytype"] == "weekday", "board"].sum()
        network = build(tables, BusConfig())[0]
        assert least * stated <= network.boarding_rate.sum() * BIN_S <= stated * (1 + 1e-9)
    hours = few.demand[(few.demand["board"] > 0) & (few.demand["daytype"] == "weekday")]["hour"]
    assert set(hours) == {6, 7, 22, 23, 24}  # for buses of 08:01 and 23:58
    late = imported(
        write_feed(frequencies="trip_id,start_time,end_time,headway_secs\nout,31:00:00,31:10:00,600\n")
    )
    out = late.patterns.loc[late.patterns["dir"] == "I", "pattern"].iloc[0]
    own = late.demand[(late.demand["pattern"] == out) & (late.demand["daytype"] == "weekday")]
    assert own["board"].sum() == pytest.approx(47.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"stop_times": None}, "there is no stop_times.txt"),
        ({"calendar": None}, "neither calendar.txt nor calendar_dates.txt"),
        ({"trips": "route_id,service_id\nr1,work\n"}, "trips.txt has no column trip_id"),
        ({"stops": "stop_id,stop_lat,stop_lon\n"}, "stops.txt has no rows"),
        (
            {"stops": "stop_id,stop_lat,stop_lon\nA,north,2\n"},
            "stops.txt, line 2, stop_lat: 'north' is not a number",
        ),
        ({"stops": "stop_id,stop_lat,stop_lon\nA,95,2\nD,1,1\n"}, "stop A lies nowhere on Earth"),
        ({"routes": "route_id,route_type\nr1,2\n"}, "no route is a bus; its route types are 2"),
        (
            {"stop_times": "trip_id,arrival_time,stop_id,stop_sequence\nout,8h,A,1\n"},
            "stop_times.txt, line 2, arrival_time: '8h' is not a time",
        ),
        (
            {"stop_times": "trip_id,arrival_time,stop_id,stop_sequence\nout,08:00:00,A,1\n"},
            "no trip of the chosen days has two calls",
        ),
        (
            {"stop_times": "trip_id,arrival_time,stop_id,stop_sequence\nout,8\n"},
            "is not a table of comma-separated",
        ),
        (
            {"frequencies": "trip_id,start_time,end_time,headway_secs\nout,06:00:00,07:00:00,0\n"},
            "frequencies.txt, line 2: headway_secs must be above 0",
        ),
        (
            {"calendar_dates": "service_id,date,exception_type\nwork,2024-05-07,1\n"},
            "calendar_dates.txt, line 2, date: '2024-05-07' is not a date YYYYMMDD",
        ),
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


def test_files_of_two_feeds_are_not_mixed(write_feed: FeedWriter, tmp_path: Path) -> None:
    folder = write_feed()
    (folder / "old").mkdir()
    (folder / "old" / "notes.txt").write_text("of last year")
    imported(folder)
    (folder / "old" / "stops.txt").write_text("stop_id,stop_lat,stop_lon\nA,1,1\n")
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
def test_a_city_is_read_in_seconds(city_feed: Path) -> None:
    began = time.process_time()
    tables = imported(city_feed)
    assert time.process_time() - began < 30.0  # 5 s alone; a busy machine is slower
    assert len(tables.patterns) == 760
    assert len(tables.trips) == 22_800
    assert tables.trips["vehicle"].nunique() < 22_800

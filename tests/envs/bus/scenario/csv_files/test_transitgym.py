"""Import of TransitGym's tables, on files of that format made by hand."""

from pathlib import Path

import numpy as np
import pytest

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig
from headway_envs.bus.prepare import prepare
from headway_envs.bus.scenario.csv_files.transitgym import import_transitgym
from headway_envs.bus.scenario.tables import check_tables, write_tables

FILES = {
    "stops.txt": ",stop_id,stop_lat,stop_lon\n0,65009,0,0\n1,65259,0,0\n2,65409,0,0\n3,65141,0,0\n",
    "trips.txt": ",trip_id,shape_id,route_id\n0,9153,43_1,43_1\n1,1419,43_1,43_1\n",
    # Rows in no order; the second trip takes 80 s instead of 60 s for the first link.
    "stop_times.txt": ",stop_id,arrival_time,shape_dist_traveled,trip_id,service_id\n"
    "0,65009,1900-01-01 07:00:00,0.0,9153,0\n"
    "1,65409,1900-01-01 07:03:00,0.9,9153,0\n"
    "2,65259,1900-01-01 07:01:00,0.4,9153,0\n"
    "3,65141,1900-01-01 07:06:30,1.7000000000000002,9153,0\n"
    "4,65009,1900-01-01 07:30:00,0.0,1419,0\n"
    "5,65259,1900-01-01 07:31:20,0.4,1419,0\n"
    "6,65409,1900-01-01 07:33:00,0.9,1419,0\n"
    "7,65141,1900-01-01 07:36:30,1.7000000000000002,1419,0\n",
    "demand.csv": ",Srvc_Number,Direction,BUS_REG_NUM,BOARDING_STOP_STN,ALIGHTING_STOP_STN,Ride_Start_Time,"
    "Ride_Distance,Ride_Time,TripID\n"
    "1,43   ,1.0,5196.0,65009,65409,1900-01-01 07:05:14,0.9,4.783,2\n"
    "2,43   ,1.0,5196.0,65009,65409.0,1900-01-01 07:35:14,0.9,4.783,3\n"
    "3,43   ,1.0,5196.0,65009,65141,1900-01-01 07:35:20,1.7,5.0,4\n"
    "4,43   ,1.0,5196.0,65259,65141,1900-01-01 07:31:00,1.3,5.0,5\n"
    "5,43   ,1.0,5196.0,65259,,1900-01-01 07:31:00,,,6\n"
    "6,43   ,1.0,5196.0,65409,65259,1900-01-01 07:31:00,0.5,2.0,7\n",
}


@pytest.fixture
def line(tmp_path: Path) -> Path:
    folder = tmp_path / "SG_43_1"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def edit(folder: Path, name: str, old: str, new: str, count: int = 1) -> None:
    text = (folder / name).read_text(encoding="utf-8")
    assert old in text
    (folder / name).write_text(text.replace(old, new, count), encoding="utf-8")


def test_a_line_s_stops_link_times_and_demand(line: Path, tmp_path: Path) -> None:
    tables = import_transitgym(line)
    check_tables(tables)
    name = tables.stops.set_index("stop")["name"].astype(str)
    calls = tables.pattern_stops.sort_values("seq0")
    assert calls["stop"].map(name).tolist() == ["65009", "65259", "65409", "65141"]
    links = tables.links.assign(origin=tables.links["from_stop"].map(name)).set_index("origin")
    assert links["leg_m"].to_dict() == {"65009": 400.0, "65259": 500.0, "65409": 800.0}
    times = tables.link_times.merge(links.reset_index(), on="link").set_index("origin")["mean_s"]
    assert times.to_dict() == {"65009": 70.0, "65259": 110.0, "65409": 210.0}
    # Rides of an hour by stop; the one without a destination and the one back are left out.
    assert tables.demand.set_index("seq0")["board"].to_dict() == {0: 3.0, 1: 1.0}
    off = tables.alighting[tables.alighting["period"] == 0].sort_values("seq0")["p_alight"]
    assert off.tolist() == pytest.approx([0.0, 0.0, 2 / 4, 1.0])
    assert tables.trips["dep_s"].tolist() == [25_200.0, 27_000.0]
    assert tables.trips["arr_s"].tolist() == [25_590.0, 27_390.0]
    assert tables.meta["made_up"]["coordinates"] == "a straight road"
    assert list(tables.meta["counted"].values()) == [1, 1]
    metres = np.diff(tables.stops["lon"].sort_values()) * 111_320.0
    assert metres == pytest.approx([400.0, 500.0, 800.0])
    write_tables(tables, tmp_path / "mine")
    config = BusConfig(scenario=str(tmp_path / "mine"), start_hour=6, end_hour=9)
    assert len(prepare(config).network.trip_departure) == 2


def test_times_without_dates_and_stops_with_coordinates(line: Path) -> None:
    dated = import_transitgym(line).arrays()
    for name in ("stop_times.txt", "demand.csv"):
        edit(line, name, "1900-01-01 ", "", -1)
    for row, place in enumerate(("1.30,103.800", "1.30,103.803", "1.30,103.807", "1.30,103.814")):
        edit(
            line,
            "stops.txt",
            f"{(65009, 65259, 65409, 65141)[row]},0,0",
            f"{(65009, 65259, 65409, 65141)[row]},{place}",
        )
    tables = import_transitgym(line)
    assert tables.stops["lon"].tolist() == [103.800, 103.803, 103.807, 103.814]
    assert "coordinates" not in tables.meta["made_up"]
    for name in ("link_times", "demand", "trips", "links"):
        for column, values in tables.arrays()[name].items():
            np.testing.assert_array_equal(values, dated[name][column])


def test_times_after_midnight_continue(line: Path) -> None:
    late = ("01 23:58:00", "01 23:59:20", "02 00:01:00", "02 00:04:30")
    for old, new in zip(("07:30:00", "07:31:20", "07:33:00", "07:36:30"), late, strict=True):
        edit(line, "stop_times.txt", f"01 {old}", new)
    trips = import_transitgym(line).trips
    assert trips["dep_s"].tolist() == [25_200.0, 86_280.0]
    assert trips["arr_s"].tolist() == [25_590.0, 86_670.0]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "stop_times.txt",
            "07:33:00",
            "7h33",
            "stop_times.txt, row 8, column arrival_time: '.*7h33' is not a",
        ),
        ("stop_times.txt", "0.9,1419", "0.3,1419", "row 8, column shape_dist_traveled: '0.3' is not beyond"),
        ("stop_times.txt", "5,65259", "5,11111", "row 7, column stop_id: stop '11111' is not in stops.txt"),
        ("stop_times.txt", "6,65409,1900-01-01 07", "\n6,65409,1900-01-01 7h", "row 9, column arrival_time"),
        ("stops.txt", "65009,0", "65009,north", "stops.txt, row 2, column stop_lat: 'north' is not a number"),
        (
            "trips.txt",
            "route_id",
            "line_id",
            "trips.txt, row 1: there is no column route_id; the columns are",
        ),
        ("trips.txt", "9153", "9999", None),
        ("demand.csv", "07:05:14", "soon", "demand.csv, row 2, column Ride_Start_Time"),
        (
            "demand.csv",
            "01 07:35:20",
            "02 07:35:20",
            "demand.csv, row 4, column Ride_Start_Time: '1900-01-02 07:35:20' is of another day",
        ),
        (
            "stop_times.txt",
            "07:00:00",
            "03:00:00",
            "SG_43_1, rewritten as CSV files of an operator: link_times.csv, row 2, column mean_s: '14460.0'",
        ),
    ],
)
def test_faults_are_one_line(line: Path, name: str, old: str, new: str, message: str | None) -> None:
    edit(line, name, old, new)
    if message is None:
        assert import_transitgym(line).meta["counted"]["calls of trips that trips.txt lacks, left out"] == 4
        return
    with pytest.raises(HeadwayError, match=message) as caught:
        import_transitgym(line)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(line: Path) -> None:
    (line / "demand.csv").unlink()
    with pytest.raises(
        HeadwayError, match=r"demand.csv is missing; TransitGym's tables are stops.txt, trips"
    ):
        import_transitgym(line)
    with pytest.raises(HeadwayError, match="is not a folder"):
        import_transitgym(line / "none")

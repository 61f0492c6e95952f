"""Import of an operator's CSV files: the guide's example, and days that are written and read again."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from headway.contracts import HeadwayError
from headway_envs.bus.config import BusConfig, NoiseConfig
from headway_envs.bus.prepare import prepare, prepare_replay
from headway_envs.bus.realism import trip_statistics
from headway_envs.bus.realism.calls import COLUMNS, recorded_day, simulated_days
from headway_envs.bus.realism.comparison import OWN, compare_replay
from headway_envs.bus.scenario.csv_files.files import read_texts
from headway_envs.bus.scenario.csv_files.importer import import_csv
from headway_envs.bus.scenario.source import scenario_tables
from headway_envs.bus.scenario.tables import check_tables, write_tables

GUIDE = Path(__file__).resolve().parents[5] / "docs" / "howto" / "scenario.md"
EVEN = NoiseConfig(day_sd=0.0, evening_peak=0.0, network_sd=0.0, incident_probability=0.0)
"""Days that differ little, so that two have nearly the same means."""
PLANNED = ("stops", "lines", "trips", "link_times", "demand")


def _examples() -> dict[str, str]:
    """Return the guide's files by name; the block of each follows its name."""
    blocks = re.findall(r"`(\w+)\.csv`:\n\n```text\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    return dict(blocks)


def _write(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / f"{name}.csv").write_text(_examples()[name], encoding="utf-8")
    return folder


@pytest.fixture
def example(tmp_path: Path) -> Path:
    return _write(tmp_path, *PLANNED)


def _edit(folder: Path, name: str, old: str, new: str) -> None:
    file = folder / f"{name}.csv"
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_the_example_of_the_guide_is_a_scenario(example: Path, tmp_path: Path) -> None:
    tables = import_csv(example)
    check_tables(tables)
    names = tables.stops.set_index("stop")["name"]
    assert list(tables.patterns["dir"]) == ["back", "out"]
    link = tables.links[
        (tables.links["from_stop"].map(names) == "Station") & (tables.links["to_stop"].map(names) == "Market")
    ]
    assert link["leg_m"].item() == 640.0
    times = tables.link_times[tables.link_times["link"] == link["link"].item()]
    assert times[["hour", "mean_s", "daytype"]].to_numpy().tolist() == [[7, 165.0, "weekday"]]
    # A lognormal time with this log_sigma has the stated ratio of sd and mean.
    assert np.sqrt(np.exp(times["log_sigma"].item() ** 2) - 1.0) == pytest.approx(35 / 165)
    assert tables.demand["board"].sum() == 84 + 22 + 30 + 12
    assert tables.demand["calls"].tolist() == [3, 3, 4, 4]
    out = tables.alighting[(tables.alighting["pattern"] == 1) & (tables.alighting["period"] == 0)]
    assert out["p_alight"].tolist() == pytest.approx([0.0, 31 / 84, 1.0])
    assert tables.trips["vehicle"].nunique() == 2
    write_tables(tables, tmp_path / "mine")
    assert len(prepare(BusConfig(scenario=str(tmp_path / "mine"))).agents) == 2


def test_a_spreadsheet_s_semicolons_and_decimal_commas_are_the_same(example: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for name in PLANNED:
        text = (example / f"{name}.csv").read_text(encoding="utf-8")
        text = text.replace(",", ";").replace(".", ",")
        (other / f"{name}.csv").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    one, two = import_csv(example).arrays(), import_csv(other).arrays()
    for table, columns in one.items():
        for column, values in columns.items():
            np.testing.assert_array_equal(values, two[table][column])


def test_origin_destination_counts_give_both_ends(example: Path) -> None:
    (example / "demand.csv").write_text(
        "line,direction,stop,to_stop,hour,boardings\n"
        "1,out,Station,Market,7,20\n1,out,Station,Hospital,7,60\n1,out,Market,Hospital,7,5\n",
        encoding="utf-8",
    )
    tables = import_csv(example)
    assert tables.demand["board"].tolist() == [80.0, 5.0]
    out = tables.alighting[(tables.alighting["pattern"] == 1) & (tables.alighting["period"] == 3)]
    assert out["p_alight"].tolist() == pytest.approx([0.0, 20 / 80, 1.0]), (
        "evenings have no counts of their own"
    )


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("stops", "52.5240", "52,5240", "stops.csv, row 3: 4 cells separated by ',', where the heading"),
        ("stops", "Station,", "Station,0,", "stops.csv, row 2: 4 cells separated by ',', where the heading"),
        ("stops", "Market", '"Market', "stops.csv, row 3: a quotation mark is not closed"),
        ("stops", "stop,", '"stop,' + 140_000 * "x", "stops.csv, row 1: a quotation mark is not closed"),
        ("stops", "Market", "\n,,\nMarket,1", "stops.csv, row 5: 4 cells separated by ','"),
        ("stops", "Market,52", "\n,,\nMarket,x", "stops.csv, row 5, column lat: 'x.5240' is not a number"),
        ("stops", "52.5240", "north", "stops.csv, row 3, column lat: 'north' is not a number; correct it"),
        ("stops", "52.5240", "", "stops.csv, row 3, column lat: is blank; fill it in"),
        ("stops", "52.5240", "525240", "row 3, column lat: '525240' lies outside -90 to 90; correct it"),
        ("stops", "lat,", "latitude,", "stops.csv, row 1: there is no column lat: add it; the columns are"),
        ("stops", "Market", "Station", "stops.csv, row 3, column stop: 'Station' names an earlier stop"),
        ("lines", "out,Market", "out,Markt", "lines.csv, row 3, column stop: 'Markt' is not in stops.csv"),
        ("lines", "out,Market", "out,Station", "lines.csv, row 3, column stop: 'Station' follows its"),
        ("lines", "out,Station", "oot,Station", "row 2, column stop: 'Station' is the only stop of its dir"),
        ("lines", "Market,640", "Market,0.64", "lines.csv, row 3, column distance_m: '0.64' is shorter than"),
        ("trips", "07:06", "07:16", "trips.csv, row 3, column vehicle: 'A' is still on an earlier trip"),
        ("trips", "07:06", "7.06", "trips.csv, row 2, column arrival: '7.06' is not a time HH:MM or"),
        ("trips", "07:06", "00:06", "trips.csv, row 2, column arrival: '00:06:00' is before the departure"),
        ("trips", "07:06", "81:00", "trips.csv, row 2, column arrival: '81:00:00' is after 48:00; correct"),
        ("trips", "1,out", "1,west", "trips.csv, row 2, column direction: 'west' is not a direction of this"),
        ("trips", "line,", "day_typ,line,", "trips.csv, row 1: there is no column day_type: rename 'day"),
        ("link_times", "165", "16", "link_times.csv, row 2, column mean_s: '16.0' is faster than 90 km/h"),
        ("link_times", "Station,Market", "Station,Hospital", "row 2, column to_stop: 'Hospital' does not"),
        ("link_times", "Station,Market,7,165,35\n", "", "lines.csv, row 3, column stop: 'Market' has no"),
        ("link_times", "Market,7", "Market,2", "lines.csv, row 3, column stop: 'Market' has no time on a"),
        ("link_times", "Market,7", "Market,30", "the stop before for an hour from 3 to 27; add it to link"),
        ("link_times", "Hospital,Market,7", "Station,Market,7", "row 4, column hour: '7.0' repeats"),
        ("link_times", ",7,165", ",7.5,165", "row 2, column hour: '7.5' is not a whole number; correct it"),
        ("demand", "Station,7,84", "Station,7,-84", "row 2, column boardings: '-84' lies outside 0 to"),
        ("demand", "Hospital,7,0,75", "Hospital,7,4,75", "row 4, column boardings: '4.0' board at the last"),
        ("demand", "Market,7,22,31", "Station,7,22,31", "row 3, column hour: '7.0' repeats an earlier row"),
        ("demand", "22,31", "22,", "demand.csv, row 3, column alightings: is blank; fill it in"),
        ("demand", "line,", "Line,", "demand.csv, row 1: there is no column line"),
    ],
)  # fmt: skip
def test_a_fault_is_named_by_file_row_and_column(
    example: Path, name: str, old: str, new: str, said: str
) -> None:
    _edit(example, name, old, new)
    with pytest.raises(HeadwayError) as error:
        import_csv(example)
    assert said in str(error.value), error.value
    assert "\n" not in str(error.value)


def test_another_fault_is_given_in_the_words_of_pandas(tmp_path: Path) -> None:
    path = tmp_path / "stops.csv"
    path.write_text("\ufeff\ufeff\n\nstop\n1\n", encoding="utf-8")
    with pytest.raises(HeadwayError, match=r"^stops.csv cannot be read \(No columns to parse from file\)"):
        read_texts(path)


def test_pairs_with_alightings_are_refused(example: Path) -> None:
    (example / "demand.csv").write_text(
        "line,direction,stop,to_stop,hour,boardings,alightings\n1,out,Station,Market,7,20,3\n"
    )
    with pytest.raises(HeadwayError, match=r"row 2, column alightings: '3.0' is given beside to_stop; rem"):
        import_csv(example)


def test_boardings_without_trips_are_left_out(example: Path) -> None:
    rows = [f"{day},1,out,Station,{hour},{n}" for day, hour, n in
            (("weekday", 7, 9), ("weekday", 12, 4), ("sunday", 7, 2))]  # fmt: skip
    (example / "demand.csv").write_text("day_type,line,direction,stop,hour,boardings\n" + "\n".join(rows))
    tables = import_csv(example)
    assert tables.demand["board"].tolist() == [9.0]
    assert tables.meta["counted"] == {"boardings in hours without trips, left out": 6}
    _edit(example, "demand", "Station,7,9", "Station,13,9")
    with pytest.raises(HeadwayError, match="a weekday has trips but no boardings in their hours: make"):
        import_csv(example)


def test_a_link_of_two_distances_has_their_mean(example: Path) -> None:
    _edit(example, "lines", "1,out,Hospital,720\n", "1,out,Hospital,720\n2,out,Station,\n2,out,Market,650\n")
    tables = import_csv(example)
    assert sorted(tables.links["leg_m"]) == [640.0, 645.0, 720.0, 720.0]
    assert tables.meta["counted"] == {"links of several distances, given their mean": 1}


def test_a_loop_needs_positions(example: Path) -> None:
    _edit(example, "lines", "1,out,Hospital,720\n", "1,out,Hospital,720\n1,out,Station,1300\n")
    (example / "demand.csv").write_text(
        "line,direction,stop,hour,boardings\n1,out,Station,7,9\n1,back,Hospital,7,9\n", encoding="utf-8"
    )
    _edit(example, "link_times", "Market,Station", "Hospital,Station,7,150,\nMarket,Station")
    with pytest.raises(
        HeadwayError, match=r"demand.csv, row 2, column stop: 'Station' has several calls: add"
    ):
        import_csv(example)
    (example / "demand.csv").write_text(
        "line,direction,stop,position,hour,boardings\n1,out,Station,1,7,9\n1,back,Hospital,,7,9\n",
        encoding="utf-8",
    )
    assert import_csv(example).demand["board"].tolist() == [9.0, 9.0]


def test_trips_that_are_only_planned_are_no_measurement(example: Path) -> None:
    with pytest.raises(HeadwayError, match=r"trips are made up or scheduled, so there are no measurements"):
        compare_replay(import_csv(example), BusConfig(), 1)


def _clock(s: float) -> str:
    return f"{int(s) // 3600}:{int(s) % 3600 // 60:02d}:{int(s) % 60:02d}"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    """Return a folder with a simulated day of the synthetic line as its calls.csv, and that day."""
    folder = tmp_path_factory.mktemp("recorded")
    tables = scenario_tables("line", 0)
    day = next(
        simulated_days(tables, prepare_replay(BusConfig(start_hour=4, end_hour=26, noise=EVEN), tables), 1)
    )
    tables.stops.to_csv(folder / "stops.csv", index=False)
    calls = tables.pattern_stops.merge(tables.patterns, on="pattern").merge(
        tables.links, on="link", how="left"
    )
    names = {"dir": "direction", "leg_m": "distance_m"}
    calls.rename(columns=names).to_csv(folder / "lines.csv", index=False)
    carried = day["load"].fillna(0.0)
    before = carried.groupby(day["trip"]).shift().fillna(0.0)
    day.assign(
        date="2024-05-15",
        direction=day["dir"],
        alightings=before + day["boarded"] - carried,
        boardings=day["boarded"],
        arrival=day["arrived"].map(_clock, na_action="ignore"),
        departure=day["left"].map(_clock, na_action="ignore"),
    ).to_csv(folder / "calls.csv", index=False)
    return folder, day


def test_recorded_calls_give_trips_link_times_and_passengers(recorded: tuple[Path, pd.DataFrame]) -> None:
    folder, day = recorded
    tables = import_csv(folder)
    check_tables(tables)
    assert tables.meta["dates"] == {"weekday": "2024-05-15"}
    first, last = day[day["seq0"] == 0], day[day["seq0"] == day["calls"] - 1]
    np.testing.assert_array_equal(np.sort(tables.trips["dep_s"]), np.sort(np.floor(first["left"])))
    np.testing.assert_array_equal(np.sort(tables.trips["arr_s"]), np.sort(np.floor(last["arrived"])))
    assert tables.demand["board"].sum() == day["boarded"].sum()
    link = tables.pattern_stops.set_index(["pattern", "seq0"]).loc[(0, 5), "link"]
    own = tables.link_times[tables.link_times["link"] == link].set_index("hour")["mean_s"]
    here = day[day["pattern"] == day["pattern"].min()].sort_values(["trip", "seq0"])
    legs = here["time"].diff()[here["seq0"] == 5]
    leaves = here["time"].shift()[here["seq0"] == 5] // 3600
    hourly = legs.groupby(leaves).mean()
    assert own.loc[hourly.index].corr(hourly) > 0.5, "means of hours follow the recorded ones"
    assert own.loc[hourly.index].mean() == pytest.approx(hourly.mean(), rel=0.1)


def test_a_recorded_day_is_compared_with_the_user_s_own_calls(recorded: tuple[Path, pd.DataFrame]) -> None:
    folder, day = recorded
    tables = import_csv(folder)
    own = recorded_day(folder, tables, "weekday")
    assert set(own.calls.columns) == set(COLUMNS)
    assert own.fares
    inner = day["left"].notna() & day["arrived"].notna()
    dwell = (day["left"] - day["arrived"])[inner].mean()
    rows = {row.statistic: row for row in compare_replay(tables, BusConfig(noise=EVEN), 2, folder)}
    assert rows[trip_statistics.DWELL].measured == pytest.approx(dwell, abs=0.1)
    assert rows[trip_statistics.cv_name(4)].source == "records of its lines, 2024-05-15"
    assert rows[trip_statistics.TRIP_MEAN].source == OWN
    assert rows[trip_statistics.LOAD_P50].measured == day["load"].median()
    assert rows[trip_statistics.BOARDINGS].measured == day["boarded"].sum()
    for name in (trip_statistics.TRIP_MEAN, trip_statistics.TRIP_P50, trip_statistics.DWELL):
        assert rows[name].holds, rows[name]
    another = replace(tables, meta={"dates": {"weekday": "2024-05-16"}})
    with pytest.raises(HeadwayError, match=r"has no trip of the scenario's lines on 2024-05-16"):
        recorded_day(folder, another, "weekday")


def test_boardings_at_the_last_stop_are_left_out(tmp_path: Path) -> None:
    _write(tmp_path, "stops", "lines", "calls")
    _edit(tmp_path, "calls", "07:06:02,,0,17", "07:06:02,,5,17")
    tables = import_csv(tmp_path)
    assert tables.demand["board"].sum() == 19 + 6
    assert tables.meta["counted"]["boardings at the last stop of a direction, left out"] == 5
    assert recorded_day(tmp_path, tables, "weekday").calls["boarded"].sum() == 19 + 6


def test_a_partly_recorded_trip_is_completed_and_not_judged(tmp_path: Path) -> None:
    _write(tmp_path, "stops", "lines", "calls")
    file = tmp_path / "calls.csv"
    heading, first, middle, last = file.read_text(encoding="utf-8").splitlines()
    late = [row.replace("101,A", "102,B").replace("07:0", "07:3") for row in (middle, last)]
    early = [row.replace("101,A", "103,C").replace("07:0", "07:4") for row in (first, middle)]
    file.write_text("\n".join([heading, first, middle, last, *late, *early]), encoding="utf-8")
    tables = import_csv(tmp_path)
    assert tables.meta["counted"]["trips without their first or last calls, completed by link times"] == 2
    times = tables.link_times[tables.link_times["hour"] == 7].set_index("link")["mean_s"]
    links = tables.pattern_stops.query("pattern == 1").set_index("seq0")["link"]
    clock = 7 * 3600
    assert tables.trips["dep_s"].tolist() == [
        clock + 20, clock + 32 * 60 + 48 - round(times[links[1]]), clock + 40 * 60 + 20
    ]  # fmt: skip
    assert tables.trips["arr_s"].tolist() == [
        clock + 362, clock + 36 * 60 + 2, clock + 42 * 60 + 48 + round(times[links[2]])
    ]  # fmt: skip
    day = recorded_day(tmp_path, tables, "weekday").calls
    whole = trip_statistics.finished_trips(day, pd.Series({1: 1.36}))
    assert (whole["arr"] - whole["dep"]).tolist() == [342.0]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("07:02:48,07:03:10", "06:02:48,07:03:10", "row 3, column arrival: '06:02:48' is before the"),
        ("07:02:48,07:03:10", "07:02:48,07:02:10", "row 3, column departure: '07:02:10' is before arrival"),
        ("07:02:48,07:03:10", ",", "row 3, column arrival: is blank, as is departure; fill in one"),
        ("2024-05-15,101,A,1,out,Market", "15.05.2024,101,A,1,out,Market", "'15.05.2024' is not a date YYYY"),
        ("101,A,1,out,Market", "101,A,1,back,Market", "row 3, column trip: '101' is a trip of another"),
        ("out,Market", "out,Station", "row 3, column stop: 'Station' is given twice for this trip"),
        (",19,0", ",,0", "has no passenger counts: make demand.csv, or fill boardings and alightings in"),
    ],
)  # fmt: skip
def test_faults_of_recorded_calls(tmp_path: Path, old: str, new: str, said: str) -> None:
    _write(tmp_path, "stops", "lines", "calls")
    _edit(tmp_path, "calls", old, new)
    with pytest.raises(HeadwayError) as error:
        import_csv(tmp_path)
    assert said in str(error.value), error.value


def test_saturdays_alone_are_refused(tmp_path: Path) -> None:
    _write(tmp_path, "stops", "lines")
    text = _examples()["calls"].replace("2024-05-15", "2024-05-18")
    (tmp_path / "calls.csv").write_text(text, encoding="utf-8")
    with pytest.raises(HeadwayError, match=r"calls.csv has Saturdays only, which are left out: add"):
        import_csv(tmp_path)


def test_recorded_trips_of_a_vehicle_that_overlap_are_counted(tmp_path: Path) -> None:
    _write(tmp_path, "stops", "lines", "calls")
    file = tmp_path / "calls.csv"
    heading, *rows = file.read_text(encoding="utf-8").splitlines()
    second = [row.replace("101,A", "102,A").replace("07:0", "07:1") for row in rows]
    counted = "trips that leave before their vehicle arrives from another"
    for later, overlaps in ((second, 0), ([row.replace("07:1", "07:0") for row in second], 1)):
        file.write_text("\n".join([heading, *rows, *later]), encoding="utf-8")
        assert import_csv(tmp_path).meta["counted"].get(counted, 0) == overlaps


def test_a_missing_file_is_named_with_what_may_replace_it(example: Path) -> None:
    (example / "trips.csv").rename(example / "planned_departures.csv")
    with pytest.raises(HeadwayError, match=r"trips.csv is missing: write it, or calls.csv with recorded"):
        import_csv(example)
    (example / "planned_departures.csv").rename(example / "trip.csv")
    with pytest.raises(HeadwayError, match=r"trips.csv is missing: write it \(rename trip.csv\?\), or"):
        import_csv(example)


def test_records_without_calls_are_refused(tmp_path: Path) -> None:
    tables = import_csv(_write(tmp_path, "stops", "lines", "calls"))
    (tmp_path / "calls.csv").unlink()
    with pytest.raises(HeadwayError, match=r"--records: there is no calls.csv in .*; give the folder that"):
        recorded_day(tmp_path, tables, "weekday")


def test_plans_beside_records_are_refused(tmp_path: Path) -> None:
    _write(tmp_path, "stops", "lines", "calls", "trips", "link_times")
    with pytest.raises(HeadwayError, match=r"calls.csv replaces trips.csv and link_times.csv; keep them"):
        import_csv(tmp_path)

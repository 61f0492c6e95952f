"""Small feeds of buses as importers read them: GTFS, and SUNT's raw files."""

import datetime as dt
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

WEEKDAY, SUNDAY = dt.date(2024, 8, 26), dt.date(2024, 9, 15)
STOPS = 6
SMALL: Mapping[str, str] = {
    "agency": "agency_id,agency_name,agency_url,agency_timezone\na,Town Buses,http://x,UTC\n",
    "stops": (
        "stop_id,stop_name,stop_lat,stop_lon,parent_station,location_type\n"
        "A,Market,10.000,20.000,,0\n"
        "B,Mill,10.010,20.000,,0\n"
        "C1,Quay east,10.030,20.000,C,0\n"
        "C2,Quay west,10.030,20.001,C,0\n"
        "C,Quay,10.030,20.000,,1\n"
        "D,Hill,10.040,20.000,,0\n"
    ),
    "routes": (
        "route_id,agency_id,route_short_name,route_long_name,route_type\n"
        "r1,a,1,One,3\n"
        "metro,a,M,Metro,1\n"
    ),
    "trips": (
        "route_id,service_id,trip_id,direction_id\n"
        "r1,work,out,0\n"
        "r1,work,back,1\n"
        "r1,rest,sun,0\n"
        "metro,work,under,0\n"
    ),
    "stop_times": (
        "trip_id,arrival_time,departure_time,stop_id,stop_sequence\n"
        "out,08:00:00,08:01:00,A,1\n"
        "out,,,B,25\n"
        "out,,,C1,44\n"
        "out,08:09:00,08:09:00,D,60\n"
        "back,23:58:00,23:58:00,D,1\n"
        "back,24:02:00,24:02:00,C2,2\n"
        "back,25:10:00,25:10:00,A,3\n"
        "sun,09:00:00,09:00:00,A,1\n"
        "sun,09:05:00,09:05:00,D,2\n"
        "under,07:00:00,07:00:00,A,1\n"
        "under,07:05:00,07:05:00,D,2\n"
    ),
    "calendar": (
        "service_id,monday,tuesday,wednesday,thursday,friday,saturday,sunday,start_date,end_date\n"
        "work,1,1,1,1,1,0,0,20240506,20240519\n"
        "rest,0,0,0,0,0,0,1,20240506,20240519\n"
    ),
}  # fmt: skip


def write_gtfs(folder: Path, changed: Mapping[str, str | None]) -> Path:
    """Write the small feed; `changed`: contents of files, None to leave one out."""
    folder.mkdir(exist_ok=True)
    for name, text in {**SMALL, **changed}.items():
        if text is not None:
            (folder / f"{name}.txt").write_text(text)
    return folder


def records(date: dt.date, trips: int = 20, board: float = 3.0, alight: float = 3.0) -> pd.DataFrame:
    """Return trips of both directions of line 7, every half hour from 06:00, one minute between stops."""
    trip, seq = np.repeat(np.arange(trips), STOPS), np.tile(np.arange(1, STOPS + 1), trips)
    leaves = pd.Timestamp(date) + pd.to_timedelta(6 * 60 + 30 * trip, unit="min")
    return pd.DataFrame(
        {
            "route_short_name": "0007",
            "register_code": 500,
            "direction_id": np.where(trip % 2, "V", "I"),
            "pt_sequence": seq,
            "stop_id": 9000 + np.where(trip % 2, STOPS + 1 - seq, seq),
            "vehicle": np.where(trip % 2, "301", "201"),
            "trip_id": [f"201_7_{number}" for number in trip],
            "start_trip": leaves.astype(str),
            "stop_time": (leaves + pd.to_timedelta(seq - 1, unit="min")).astype(str),
            "n-boardings": np.where(seq < STOPS, board, 0.0),
            "n-alighting": np.where(seq > 1, alight, 0.0),
            "lag_loading": np.where(seq > 1, 10.0, 0.0),
            "loading": 10.0,
        }
    )


def write_raw(folder: Path, days: dict[dt.date, pd.DataFrame], nodes: bool = True) -> Path:
    (folder / "od").mkdir(parents=True, exist_ok=True)
    for date, frame in days.items():
        frame.to_parquet(folder / "od" / f"od-{date}.parquet")
    stops = [str(9000 + n) for n in range(1, STOPS + 1)]
    pd.DataFrame({"stop_id": stops, "lat": -12.9 + 0.003 * np.arange(STOPS), "lon": -38.4}).to_parquet(
        folder / "gtfs_bus_topique_02_2024.parquet"
    )
    if nodes:
        times = pd.date_range("2024-03-04 05:00", "2024-03-05 00:55", freq="5min")
        pd.concat(
            pd.DataFrame(
                {"time": times, "node": stop, "lat": -12.9, "lon": -38.4, "sobe": 2.0, "carregamento": -1.0}
            )
            for stop in stops
        ).to_parquet(folder / "node_temporal_features_04-03-2024.parquet")
    return folder

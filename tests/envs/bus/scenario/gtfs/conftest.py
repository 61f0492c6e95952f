"""GTFS feeds made for tests."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

Files = Mapping[str, str]
FeedWriter = Callable[..., Path]

SMALL: Files = {
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


@pytest.fixture
def small() -> Files:
    """Return the files of the small feed."""
    return SMALL


@pytest.fixture
def write_feed(tmp_path: Path) -> FeedWriter:
    """(replaced files; None: left out) -> folder of the small feed."""

    def write(**changed: str | None) -> Path:
        folder = tmp_path / "feed"
        folder.mkdir(exist_ok=True)
        for name, text in {**SMALL, **changed}.items():
            if text is not None:
                (folder / f"{name}.txt").write_text(text)
        return folder

    return write


@pytest.fixture
def city_feed(tmp_path: Path) -> Path:
    """Return a feed of a city's size: 380 lines, 22,800 trips and 752,400 calls per weekday."""
    folder = tmp_path / "city"
    folder.mkdir()
    rng = np.random.default_rng(0)
    patterns, calls, trips = 760, 33, 30
    stops = pd.DataFrame(
        {
            "stop_id": np.arange(3000),
            "stop_lat": rng.uniform(0, 0.3, 3000),
            "stop_lon": rng.uniform(0, 0.3, 3000),
        }
    )
    stops.to_csv(folder / "stops.txt", index=False)
    lines = pd.DataFrame({"route_id": np.arange(380), "route_short_name": np.arange(380), "route_type": 3})
    lines.to_csv(folder / "routes.txt", index=False)
    pattern = np.repeat(np.arange(patterns), trips)
    frame = pd.DataFrame(
        {
            "route_id": pattern // 2,
            "service_id": "w",
            "trip_id": np.arange(len(pattern)) + 100_000,
            "direction_id": pattern % 2,
        }
    )
    frame.to_csv(folder / "trips.txt", index=False)
    ways = np.array([rng.choice(3000, calls, replace=False) for _ in range(patterns)])
    departs = np.tile(5 * 60 + 35 * np.arange(trips), patterns)
    minutes = (departs[:, None] + 2 * np.arange(calls)).ravel()
    hours = np.array([f"{m // 60:02d}:{m % 60:02d}:00" for m in range(minutes.max() + 1)])
    pd.DataFrame(
        {
            "trip_id": np.repeat(frame["trip_id"], calls).to_numpy(),
            "arrival_time": hours[minutes],
            "departure_time": hours[minutes],
            "stop_id": ways[pattern].ravel(),
            "stop_sequence": np.tile(np.arange(1, calls + 1), len(pattern)),
        }
    ).to_csv(folder / "stop_times.txt", index=False)
    (folder / "calendar.txt").write_text(
        "service_id,monday,tuesday,wednesday,thursday,friday,saturday,sunday,start_date,end_date\n"
        "w,1,1,1,1,1,0,0,20240506,20240510\n"
    )
    return folder

"""Pictures of scenarios."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.plots import _plot_map, plot_scenario
from headway_envs.bus.scenario.synthetic import generate


def test_a_picture_shows_the_map_and_the_day(tmp_path: Path) -> None:
    tables = generate("line", 0)
    figure = plot_scenario(tables, "weekday", "line")
    figure.savefig(tmp_path / "a.png")
    assert len({axes.get_xlim() for axes in figure.axes}) == 2  # the map's, and one of all hours
    with Image.open(tmp_path / "a.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    left = pixels[:, : pixels.shape[1] * 55 // 100]
    coloured = (left.max(axis=2) - left.min(axis=2) > 60).mean()
    assert coloured > 0.002  # links, not only black text on white
    plot_scenario(tables, "sunday", "line").savefig(tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "b.png").read_bytes()


def test_the_time_axis_of_a_short_service_has_numbers() -> None:
    tables = generate("line", 0)
    trips = tables.trips[(tables.trips["dep_s"] >= 25200) & (tables.trips["arr_s"] <= 30000)]
    demand = tables.demand[tables.demand["hour"] == 7]
    figure = plot_scenario(replace(tables, trips=trips, demand=demand), "weekday", "line")
    figure.draw_without_rendering()
    for axes in figure.axes[1:]:
        low, high = axes.get_xlim()
        shown = [
            tick.label1.get_text() for tick in axes.xaxis.get_major_ticks() if low <= tick.get_loc() <= high
        ]
        assert "07:30" in shown
        assert len(shown) >= 3


@pytest.mark.parametrize("turned", [False, True])
def test_the_map_of_a_straight_line_is_no_strip_and_keeps_its_scale(turned: bool) -> None:
    tables = generate("line", 0)
    if turned:
        stops = tables.stops.rename(columns={"lat": "lon", "lon": "lat"})
        tables = replace(tables, stops=stops.assign(lat=stops["lat"] + 20.0, lon=stops["lon"] - 20.0))
    axes = Figure(figsize=(8.0, 7.0)).subplots()
    _plot_map(axes, tables, tables.trips[tables.trips["daytype"] == "weekday"], "weekday")
    wide, high = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
    assert min(wide, high) == pytest.approx(0.4 * max(wide, high))
    assert (high > wide) == turned
    assert axes.get_aspect() == 1.0
    links = axes.dataLim
    assert np.mean(axes.get_ylim()) == pytest.approx((links.y0 + links.y1) / 2.0, abs=0.05 * high)
    assert np.mean(axes.get_xlim()) == pytest.approx((links.x0 + links.x1) / 2.0, abs=0.05 * wide)


def test_a_day_without_trips_is_one_line() -> None:
    tables = generate("line", 0)
    weekday = replace(tables, trips=tables.trips[tables.trips["daytype"] == "weekday"])
    with pytest.raises(HeadwayError, match="there is no trip on a sunday"):
        plot_scenario(weekday, "sunday", "")

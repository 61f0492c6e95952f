"""Pictures of a service day by `headway render`."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import ImageColor
from played import begun, repeated

from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import AWAY, MOVE, SERVICE_CENTER
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.renderer import FINER, OUT_OF_SERVICE, QUEUE, BusRenderer, _VisibleBuses, geography
from headway_envs.bus.scenario.measures import distance_m
from headway_envs.bus.scenario.source import scenario_tables


def near(picture: np.ndarray, colour: str) -> int:
    return int((np.abs(picture.astype(int) - ImageColor.getrgb(colour)).max(axis=-1) < 12).sum())


def test_calls_lie_where_the_tables_have_their_stops(line: Prepared) -> None:
    """The map is rotated so that the line lies across the picture; distances and its length are kept."""
    tables, net = scenario_tables("line", 0), line.network
    places = geography(tables, line)
    stops = tables.stops.set_index("stop")
    for pattern, (first, last) in enumerate(pairwise(net.pattern_calls)):
        calls = tables.pattern_stops[tables.pattern_stops["pattern"] == pattern].sort_values("seq0")
        lat, lon = (stops.loc[calls["stop"], name].to_numpy() for name in ("lat", "lon"))
        drawn = np.hypot(np.diff(places.right[first:last]), np.diff(places.up[first:last]))
        np.testing.assert_allclose(drawn, distance_m(lat[:-1], lon[:-1], lat[1:], lon[1:]), rtol=1e-3)
        np.testing.assert_allclose(np.diff(places.along[first:last]), calls["leg_m"].to_numpy()[1:])
    assert np.ptp(places.up) < 0.1 * np.ptp(places.right)
    assert np.hypot(*places.north) == pytest.approx(1.0)


def test_the_map_of_a_straight_line_is_no_strip_and_keeps_its_scale(line: Prepared) -> None:
    renderer = BusRenderer(line)
    left, top, right, bottom = renderer._map
    assert bottom - top >= (right - left) / 5.0
    places = np.column_stack((renderer._places.right, -renderer._places.up))
    metres, pixels = places - places[0], renderer._pixels - renderer._pixels[0]
    np.testing.assert_allclose(pixels, renderer._scale * metres, atol=1e-6)


def test_buses_queues_and_strokes_come_with_the_day(line: Prepared) -> None:
    env, renderer = begun(BusBatchedEnv(line, 1)), BusRenderer(line)
    first = renderer.render(env, at_end=False)
    assert first.dtype == np.uint8
    for _ in range(30):
        repeated(env, MOVE, 4)
        later = renderer.render(env, at_end=False)
    assert later.shape == first.shape
    assert len(renderer._panels) == 2
    for left, top, right, bottom in renderer._panels:
        strokes = (later[top:bottom] != first[top:bottom]).any(axis=-1)
        hours = np.flatnonzero(strokes.any(axis=0))
        assert strokes.sum() > 1000
        assert hours.max() <= left + (right - left) * 2 / 19 + 2  # two of nineteen hours: 5 to 24 h
    above = slice(renderer._map[1], renderer._map[3])
    assert near(later[above], QUEUE) > near(first[above], QUEUE) + 50


def test_the_diagram_has_the_hours_of_service(line: Prepared) -> None:
    """Trips that leave from 7.5 to 10.6 h, or some minutes early, take an hour, or one and a half if late."""
    renderer = BusRenderer(line)
    assert (renderer._begin_s, renderer._end_s) == (5 * 3600.0, 24 * 3600.0)
    departs = line.network.trip_departure
    share = (departs - departs.min()) / np.ptp(departs)
    network = line.network._replace(
        trip_departure=3600.0 * (7.5 + 3.1 * share), line_trip=np.full(len(line.lines), 3600.0)
    )
    short = BusRenderer(replace(line, network=network))
    assert 0 < line.config.dispatch_window_s <= 900
    assert (short._begin_s, short._end_s) == (7.25 * 3600.0, 12.25 * 3600.0)
    left, _, right, _ = short._panels[0]
    assert [short._in_panel(0, 3600.0 * hour, 0.0)[0] / FINER for hour in (7.25, 12.25)] == [left, right]


def test_each_direction_has_a_panel_in_which_buses_only_go_up(line: Prepared) -> None:
    """This is usual in the field: with both directions in one panel, meeting buses look like
    overtaking ones."""
    renderer = BusRenderer(line)
    assert renderer._directions == sorted(set(renderer._places.directions))
    for pattern, (first, last) in enumerate(pairwise(line.network.pattern_calls)):
        up = renderer._heights[first:last]
        assert (np.diff(up) > 0).all()
        assert up[0] == 0.0
        longest = renderer._longest[renderer._directions.index(renderer._places.directions[pattern])]
        if longest.start == first:
            assert up[-1] == 1.0


def test_a_bus_that_begins_the_same_direction_again_leaves_no_stroke_back(line: Prepared) -> None:
    renderer, first, last = BusRenderer(line), *line.network.pattern_calls[:2].tolist()
    pictures = []
    for hour, call in ((7.0, first), (7.2, last - 1), (7.3, first), (7.4, first + 1)):
        renderer._extend_diagram(
            _VisibleBuses(
                slots=np.array([0]),
                calls=np.array([call]),
                share=np.zeros(1),
                occupancy=np.zeros(1),
                loads=np.zeros(1, np.int64),
                out_of_service=np.zeros(1, np.bool_),
            ),
            hour * 3600,
        )
        pictures.append(np.asarray(renderer._canvas).copy())
    drawn = [bool((one != other).any()) for one, other in pairwise(pictures)]
    assert drawn == [True, False, True]


def test_a_pattern_that_starts_midway_is_drawn_from_there(line: Prepared) -> None:
    """The return direction, treated as a variant of the outward one, begins where that ends."""
    renderer = BusRenderer(line)
    renderer._places = replace(renderer._places, directions=("I", "I"))
    renderer._directions = ["I"]
    renderer._longest = [renderer._longest_pattern("I")]
    heights = renderer._diagram_heights()
    starts = sorted(heights[line.network.pattern_calls[:2]])
    assert starts[0] == 0.0
    assert starts[1] > 0.98
    assert np.nanmax(heights) == 1.0


def test_buses_at_a_centre_stand_out(line: Prepared) -> None:
    env, renderer = begun(BusBatchedEnv(line, 1)), BusRenderer(line)
    repeated(env, MOVE, 60)
    assert near(renderer.render(env, at_end=False)[: renderer._map[3]], OUT_OF_SERVICE) == 0
    while not (env.world.slots["phase"] == AWAY).any():
        repeated(env, SERVICE_CENTER, 1)
    assert near(renderer.render(env, at_end=False)[: renderer._map[3]], OUT_OF_SERVICE) > 60


def test_the_end_keeps_the_diagram_and_the_next_day_begins_a_new_one() -> None:
    short = prepare(BusConfig(end_hour=6))
    env, renderer = begun(BusBatchedEnv(short, 1)), BusRenderer(short)
    renderer.render(env, at_end=False)
    ended = repeated(env, MOVE, short.config.ticks - 5).episode_ended[0]
    while not ended:
        before = renderer.render(env, at_end=False)
        ended = repeated(env, MOVE, 1).episode_ended[0]
    last, again = renderer.render(env, at_end=True), renderer.render(env, at_end=False)
    below = slice(renderer._panels[0][1], renderer._panels[-1][3])
    np.testing.assert_array_equal(last[below], before[below])
    assert (again[below] != last[below]).any()
    above = slice(renderer._map[1], renderer._map[3])
    np.testing.assert_array_equal(last[above], before[above])

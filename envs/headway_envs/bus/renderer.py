"""Picture of a service day: a map with stops, buses and loads, above a time-space diagram of one line.

The diagram grows during the day and has one panel per direction.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from headway.contracts import BatchedEnv
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import AWAY, BROKEN, DEPOT, DRIVING
from headway_envs.bus.metrics import METRICS
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.scenario.measures import METRES_PER_DEGREE

if TYPE_CHECKING:
    from headway_envs.bus.scenario.tables import Tables

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Point = tuple[float, float]
Frame = tuple[int, int, int, int]
"""Left, top, right and bottom edge, pixels."""

FINER = 2
"""Supersampling factor: pictures are drawn this many times as large and then reduced, for smooth edges."""
WIDTH, HEADER, EDGE = 1180, 54, 14
MAP_HEIGHTS = (236, 420)
"""Minimum and maximum height of the map, pixels; in between it depends on the shape of the network. The
minimum, a fifth of the width, is for straight lines."""
PANEL_HEIGHT, TITLE, AXIS, LEGEND, LABELS = 190, 24, 18, 26, 46
"""Heights of a panel, of its title and axis, and of the legend, and the width of the labels at its left,
pixels."""
QUARTER_S = 900.0
"""A quarter of an hour, s."""
ASIDE = 5.0
"""Offset of each bus to the right of its line in driving direction, pixels, so that opposite directions stay
apart."""
NUMBERED = 40
"""Number of buses up to which the load of each is drawn as a number."""

GROUND, PAPER, ROAD, STOP, QUEUE, GRID, TEXT, FAINT = (
    "#eef1ea", "#ffffff", "#a9b0b6", "#54595e", "#7b4fa3", "#d9dde0", "#20242a", "#6b7177",
)  # fmt: skip
OUT_OF_SERVICE = "#d32f2f"
LOADS = ((0.0, "#2e9d4f"), (0.5, "#f2b705"), (1.0, "#c2185b"))
"""Colours at occupancies 0, 0.5 and 1, between which colours are interpolated."""


@dataclass(frozen=True)
class Geography:
    """Positions of the Q calls of a network."""

    right: Floats
    """(Q,) m along the direction in which the network is longest"""
    up: Floats
    """(Q,) m across it"""
    along: Floats
    """(Q,) m from the first call of the pattern"""
    north: Point
    """Direction of north (right, up), unit vector"""
    directions: tuple[str, ...]
    """(P,) direction of each pattern, as named in the tables"""


def geography(tables: "Tables", prepared: Prepared) -> Geography:
    """Return the geography of the network that was built from these tables."""
    from headway_envs.bus.scenario.measures import metres_along
    from headway_envs.bus.scenario.network import calls_of, pattern_rows

    arrays = tables.arrays()
    patterns = pattern_rows(arrays, prepared.config)
    calls = calls_of(arrays, patterns)
    along = metres_along(tables).reindex(list(zip(calls["pattern"], calls["seq0"], strict=True)))
    lat, lon = calls["lat"], calls["lon"]
    directions = tables.patterns.set_index("pattern")["dir"].astype(str).reindex(patterns)
    across = math.cos(math.radians(float(lat.mean()))) * METRES_PER_DEGREE
    places = np.column_stack((lon * across, lat * METRES_PER_DEGREE))
    places -= places.mean(axis=0)
    longest = np.linalg.eigh(np.cov(places.T))[1][:, -1]
    longest = longest if longest[0] >= 0 else -longest
    turned = places @ np.array([[longest[0], -longest[1]], [longest[1], longest[0]]])
    turned -= turned.min(axis=0)
    return Geography(
        right=turned[:, 0],
        up=turned[:, 1],
        along=np.asarray(along, np.float64),
        north=(float(longest[1]), float(longest[0])),
        directions=tuple(directions),
    )


@dataclass(frozen=True)
class _VisibleBuses:
    """The B buses of one copy outside the depot, at one time."""

    slots: Integers
    """(B,) slot of each bus"""
    calls: Integers
    """(B,) call at which each bus stands or which it left last"""
    share: Floats
    """(B,) share of the way to the next call that is covered"""
    occupancy: Floats
    """(B,) load over capacity"""
    loads: Integers
    """(B,) passengers aboard"""
    out_of_service: NDArray[np.bool_]
    """(B,) whether the bus is at the service centre or broken down"""


class BusRenderer:
    """Renderer of the bus environment (`headway.contracts.Renderer`).

    It extends the time-space diagram of a day with every picture of that day, for the line with the most
    slots.
    """

    def __init__(self, prepared: Prepared) -> None:
        from headway_envs.bus.scenario.source import scenario_tables

        tables = scenario_tables(prepared.config.scenario, prepared.config.scenario_seed)
        self._prepared, self._net = prepared, prepared.network
        self._places = geography(tables, prepared)
        self._line = int(np.argmax(np.diff(self._net.line_slots)))
        first, last = self._net.line_patterns[self._line : self._line + 2]
        self._patterns = range(first, last)
        self._directions = list(dict.fromkeys(self._places.directions[first:last]))
        self._begin_s, self._end_s = self._service()
        self._font = ImageFont.load_default(11 * FINER)
        self._small = ImageFont.load_default(9 * FINER)
        self._large = ImageFont.load_default(15 * FINER)
        self._map, self._panels = self._lay_out()
        self._size = WIDTH, self._panels[-1][3] + AXIS + LEGEND
        self._pixels, self._scale = self._project()
        self._longest = [self._longest_pattern(direction) for direction in self._directions]
        self._heights = self._diagram_heights()
        self._background = self._draw_background()
        self._canvas, self._last_time = self._background.copy(), -math.inf
        self._last_map: tuple[Image.Image, float] | None = None
        """Map and time, s, of the day's last picture with buses."""
        self._last_points: dict[int, tuple[int, int, Point]] = {}
        """Pattern, call and place in its panel of each bus in the previous picture, by slot."""

    def render(self, env: BatchedEnv, at_end: bool) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3), uint8, of the first copy.

        `at_end`: show the finished diagram with the metrics of the day, and the last map with buses. Raises
        TypeError for any other environment.
        """
        if not isinstance(env, BusBatchedEnv):
            raise TypeError(f"the picture of a bus network needs a BusBatchedEnv, not {type(env).__name__}")
        day = env.world.days[0]
        if at_end:
            picture, title = self._canvas.copy(), "End of the day"
            if self._last_map is not None:
                shown, at = self._last_map
                picture.paste(shown, (FINER * self._map[0], FINER * self._map[1]))
                title += f"; the map shows {_clock(at)}, the last time with buses"
            self._write(picture, title, _summary(env.outputs.metrics[0]))
            return _downsampled(picture)
        now = float(day["now"])
        if now <= self._last_time:
            self._canvas, self._last_points, self._last_map = self._background.copy(), {}, None
        self._last_time = now
        buses = _visible_buses(env)
        self._extend_diagram(buses, now)
        picture = self._canvas.copy()
        draw = ImageDraw.Draw(picture)
        waiting = self._draw_queues(draw, env)
        self._draw_buses(draw, buses)
        if len(buses.slots):
            left, top, right, bottom = (FINER * edge for edge in self._map)
            self._last_map = picture.crop((left, top, right, bottom)), now
        off = int(buses.out_of_service.sum())
        caption = f"{len(buses.slots) - off} buses on their lines, {off} at a service centre or broken down"
        caption += f"    {int(buses.loads.sum())} passengers on board, {waiting} waiting"
        caption += f"    team reward so far {float(day['reward']):.1f}"
        self._write(picture, _clock(now), caption)
        return _downsampled(picture)

    def _service(self) -> tuple[float, float]:
        """Return the times between which its line runs, s: quarters of an hour of the simulated day.

        From its first departure, which may be early by the dispatch window, until after its last, by one and
        a half times its longest trip: buses may be late, above all if they are held.
        """
        net, config = self._net, self._prepared.config
        departs = net.trip_departure[np.isin(net.trip_pattern, self._patterns)]
        begin = float(departs.min()) - config.dispatch_window_s
        end = float(departs.max() + 1.5 * net.line_trip[self._line])
        return (
            max(math.floor(begin / QUARTER_S) * QUARTER_S, config.start_hour * 3600.0),
            min(math.ceil(end / QUARTER_S) * QUARTER_S, config.end_hour * 3600.0),
        )

    def _lay_out(self) -> tuple[Frame, list[Frame]]:
        """Return the frame of the map and those of the diagram's panels."""
        shape = float(self._places.up.max()) / max(float(self._places.right.max()), 1.0)
        height = int(np.clip(shape * WIDTH, *MAP_HEIGHTS))
        tops = [
            HEADER + height + TITLE + place * (PANEL_HEIGHT + AXIS + TITLE)
            for place in range(len(self._directions))
        ]
        return (
            (EDGE, HEADER, WIDTH - EDGE, HEADER + height),
            [(EDGE + LABELS, top, WIDTH - EDGE, top + PANEL_HEIGHT) for top in tops],
        )

    def _project(self) -> tuple[Floats, float]:
        """Return the position of every call (Q, 2), pixels, and the scale, pixels per metre."""
        left, top, right, bottom = (FINER * edge for edge in self._map)
        inset, places = 22 * FINER, self._places
        wide, high = max(float(places.right.max()), 1.0), max(float(places.up.max()), 1.0)
        scale = min((right - left - 2 * inset) / wide, (bottom - top - 2 * inset) / high)
        x = (left + right - scale * wide) / 2.0 + scale * places.right
        y = (top + bottom + scale * high) / 2.0 - scale * places.up
        return np.column_stack((x, y)), scale

    def _longest_pattern(self, direction: str) -> slice:
        """Return the calls of the line's longest pattern in a direction."""
        own = [p for p in self._patterns if self._places.directions[p] == direction]
        return max(map(self._calls_of, own), key=lambda calls: float(self._places.along[calls][-1]))

    def _calls_of(self, pattern: int) -> slice:
        return slice(self._net.pattern_calls[pattern], self._net.pattern_calls[pattern + 1])

    def _diagram_heights(self) -> Floats:
        """Return the height of each call within its panel (Q,), a share from 0 to 1; NaN on other lines.

        Heights follow the distance along the line. A shorter pattern begins where the longest pattern of its
        direction comes nearest to its first stop.
        """
        places, up = self._places, np.full(len(self._places.along), np.nan)
        for pattern in self._patterns:
            longest = self._longest[self._directions.index(places.directions[pattern])]
            calls = self._calls_of(pattern)
            apart = np.hypot(
                places.right[longest] - places.right[calls.start], places.up[longest] - places.up[calls.start]
            )
            metres = places.along[longest][int(np.argmin(apart))] + places.along[calls]
            up[calls] = np.minimum(metres / max(float(places.along[longest][-1]), 1.0), 1.0)
        return up

    def _in_panel(self, panel: int, time: float, up: float) -> Point:
        left, top, right, bottom = self._panels[panel]
        share = (time - self._begin_s) / (self._end_s - self._begin_s)
        return FINER * (left + share * (right - left)), FINER * (bottom - up * (bottom - top))

    def _draw_background(self) -> Image.Image:
        picture = Image.new("RGB", (self._size[0] * FINER, self._size[1] * FINER), GROUND)
        draw = ImageDraw.Draw(picture)
        draw.rectangle([FINER * edge for edge in self._map], PAPER)
        for first, last in pairwise(self._net.pattern_calls):
            draw.line([tuple(point) for point in self._pixels[first:last]], ROAD, 2 * FINER)
        for x, y in self._pixels:
            draw.ellipse([x - 2, y - 2, x + 2, y + 2], STOP)
        self._draw_scale(draw)
        for panel in range(len(self._panels)):
            self._draw_axes(draw, panel)
        self._draw_legend(draw)
        return picture

    def _draw_scale(self, draw: ImageDraw.ImageDraw) -> None:
        """Draw the scale bar and the north arrow."""
        metres = 10.0 ** math.floor(math.log10(120 * FINER / self._scale))
        for more in (5.0, 2.0):
            if metres * more * self._scale <= 120 * FINER:
                metres *= more
                break
        x, y = FINER * (self._map[0] + 14), FINER * (self._map[3] - 10)
        draw.line([(x, y), (x + metres * self._scale, y)], TEXT, FINER)
        label = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
        draw.text((x, y - 4 * FINER), label, TEXT, self._small, anchor="ls")
        across, up = (10 * FINER * part for part in self._places.north)
        x, y = FINER * (self._map[2] - 24), FINER * (self._map[1] + 24)
        draw.line([(x - across, y + up), (x + across, y - up)], TEXT, FINER)
        draw.text((x + 1.5 * across, y - 1.5 * up), "N", TEXT, self._small, anchor="mm")

    def _draw_axes(self, draw: ImageDraw.ImageDraw, panel: int) -> None:
        left, top, right, _ = self._panels[panel]
        draw.rectangle([FINER * edge for edge in self._panels[panel]], PAPER)
        # In a short service there are lines for quarters of an hour; every second line has its time.
        between = 3600.0 if self._end_s - self._begin_s > 4.0 * 3600.0 else QUARTER_S
        first = math.ceil(self._begin_s / between) * between
        for place, time in enumerate(np.arange(first, self._end_s + 1.0, between).tolist()):
            x, low = self._in_panel(panel, time, 0.0)
            draw.line([(x, FINER * top), (x, low)], GRID)
            if place % 2 == 0:
                label = f"{time / 3600.0:.0f} h" if between == 3600.0 else _clock(time)
                anchor = "mt" if place else "lt"  # beside the label of the distance 0
                draw.text((x, low + 4 * FINER), label, FAINT, self._small, anchor=anchor)
        kilometres = float(self._places.along[self._longest[panel]][-1]) / 1000.0
        for quarter in range(5):
            x, y = self._in_panel(panel, self._begin_s, quarter / 4.0)
            draw.line([(x, y), (FINER * right, y)], GRID)
            label = f"{kilometres * quarter / 4.0:.1f} km"
            draw.text((x - 4 * FINER, y), label, FAINT, self._small, anchor="rm")
        along_map = self._places.right[self._longest[panel]]
        side = "right" if along_map[-1] > along_map[0] else "left"
        name = f"{self._prepared.lines[self._line]}, direction {self._directions[panel]}"
        draw.text(
            (FINER * left, FINER * (top - 5)),
            f"{name} (to the {side} on the map): distance from its first stop over the day; each stroke is a "
            "bus, coloured by load",
            TEXT,
            self._font,
            anchor="ls",
        )

    def _draw_legend(self, draw: ImageDraw.ImageDraw) -> None:
        x, y = FINER * EDGE, FINER * (self._size[1] - LEGEND + 8)
        for occupancy in np.linspace(0.0, 1.0, 21):
            draw.rectangle([x, y, x + 4 * FINER, y + 9 * FINER], _colour(float(occupancy)))
            x += 4 * FINER
        x += 6 * FINER
        draw.text((x, y), "bus: empty to full", TEXT, self._font)
        x += 116 * FINER
        draw.ellipse([x, y, x + 9 * FINER, y + 9 * FINER], QUEUE)
        draw.text((x + 14 * FINER, y), "stop: area by its queue", TEXT, self._font)
        x += 186 * FINER
        draw.rectangle([x, y, x + 9 * FINER, y + 9 * FINER], OUT_OF_SERVICE)
        draw.text((x + 14 * FINER, y), "broken down or at a service centre", TEXT, self._font)

    def _draw_queues(self, draw: ImageDraw.ImageDraw, env: BusBatchedEnv) -> int:
        """Draw each queue as a disc and return the number of waiting passengers on the network.

        Areas are proportional to queues, up to a maximum radius.
        """
        waiting = env.world.queues["waiting"][0]
        for call in np.flatnonzero(waiting):
            x, y = self._pixels[call]
            radius = FINER * min(1.6 * math.sqrt(waiting[call]), 16.0)
            draw.ellipse([x - radius, y - radius, x + radius, y + radius], QUEUE)
        return int(waiting.sum())

    def _draw_buses(self, draw: ImageDraw.ImageDraw, buses: _VisibleBuses) -> None:
        half = FINER * (7.0 if len(buses.slots) <= NUMBERED else 4.0)
        for n, call in enumerate(buses.calls):
            following = min(call + 1, len(self._pixels) - 1)
            way = self._pixels[following] - self._pixels[call]
            x, y = self._pixels[call] + buses.share[n] * way
            length = math.hypot(*way)
            if length > 0:
                x, y = x - way[1] / length * ASIDE * FINER, y + way[0] / length * ASIDE * FINER
            colour = OUT_OF_SERVICE if buses.out_of_service[n] else _colour(float(buses.occupancy[n]))
            draw.rounded_rectangle([x - half, y - half, x + half, y + half], 2 * FINER, colour, TEXT)
            if len(buses.slots) <= NUMBERED:
                draw.text((x, y), f"{buses.loads[n]}", "#ffffff", self._small, anchor="mm")

    def _extend_diagram(self, buses: _VisibleBuses, now: float) -> None:
        """Extend the diagram by one stroke per bus of the line, from its position in the previous picture.

        A bus that has begun another trip or is out of service gets none, and none is drawn after the end of
        the diagram.
        """
        if now > self._end_s:
            return
        draw, reached = ImageDraw.Draw(self._canvas), {}
        for n, call in enumerate(buses.calls):
            up, slot = self._heights[call], int(buses.slots[n])
            if not math.isfinite(up) or buses.out_of_service[n]:
                continue
            pattern = int(np.searchsorted(self._net.pattern_calls, call, side="right")) - 1
            if call + 1 < self._net.pattern_calls[pattern + 1]:
                up += buses.share[n] * (self._heights[call + 1] - up)
            panel = self._directions.index(self._places.directions[pattern])
            point = self._in_panel(panel, now, float(up))
            reached[slot] = (pattern, int(call), point)
            before, since, start = self._last_points.get(slot, (-1, 0, point))
            if before == pattern and since <= call:
                draw.line([start, point], _colour(float(buses.occupancy[n])), FINER)
        self._last_points = reached

    def _write(self, picture: Image.Image, title: str, caption: str) -> None:
        draw = ImageDraw.Draw(picture)
        draw.text((FINER * 14, FINER * 8), title, TEXT, self._large)
        draw.text((FINER * 14, FINER * 32), caption, TEXT, self._font)


def _visible_buses(env: BusBatchedEnv) -> _VisibleBuses:
    """Return the buses of the first copy that are outside the depot."""
    slots, capacity = env.world.slots[0], env.prepared.config.capacity
    out = np.flatnonzero(slots["phase"] != DEPOT)
    buses, now = slots[out], float(env.world.days[0]["now"])
    arrives = env.world.event_time[0, out]
    lasts = np.maximum(arrives - buses["left"], 1.0)
    share = np.where(buses["phase"] == DRIVING, (now - buses["left"]) / lasts, 0.0)
    return _VisibleBuses(
        slots=out,
        calls=buses["call"].astype(np.int64),
        share=np.clip(share, 0.0, 1.0),
        occupancy=buses["load"] / capacity,
        loads=buses["load"].astype(np.int64),
        out_of_service=np.isin(buses["phase"], (AWAY, BROKEN)),
    )


def _summary(metrics: Floats) -> str:
    """Return a line of text with the main metrics of the day."""
    value = dict(zip(METRICS, metrics.tolist(), strict=True))
    return (
        f"mean wait {value['mean_wait_min']:.2f} min    headway CV {value['headway_cv']:.2f}    "
        f"bunched {100 * value['bunched_share']:.1f}%    denied boardings {value['denied_boardings']:.0f}    "
        f"breakdowns {value['breakdowns']:.0f}    team reward {value['team_reward']:.1f}"
    )


def _clock(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


def _colour(occupancy: float) -> str:
    """Return the colour of an occupancy, "#rrggbb"."""
    place = min(max(occupancy, 0.0), 1.0)
    for (low, begin), (high, end) in pairwise(LOADS):
        if place <= high:
            weight = (place - low) / (high - low)
            parts = [
                round((1.0 - weight) * int(begin[i : i + 2], 16) + weight * int(end[i : i + 2], 16))
                for i in (1, 3, 5)
            ]
            return "#" + "".join(f"{part:02x}" for part in parts)
    return LOADS[-1][1]


def _downsampled(picture: Image.Image) -> NDArray[np.uint8]:
    return np.asarray(picture.reduce(FINER), np.uint8)

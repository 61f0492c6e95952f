"""Pictures of the intersection, drawn without a window or screen."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from headway.contracts import BatchedEnv
from headway_envs.intersection.config import STEP_S
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.network import ROAD_M

Point = tuple[float, float]
_LANES_M = 6.4
"""Width of the lanes of one direction."""
_LENGTH_M, _WIDTH_M = 5.0, 1.8
_SCALE = 4
"""Factor by which pictures are drawn larger and then reduced, for smooth edges."""
GRASS, ROAD, LINE, TEXT = (226, 232, 222), (88, 92, 98), (214, 214, 214), (30, 30, 30)
HUMAN, CRASH = (236, 236, 236), (224, 40, 40)
SLOW, FAST = np.array((196, 64, 196)), np.array((32, 170, 255))
_MAX_SPEED = 20.0
"""Speed from which an AV has the colour FAST, m/s."""
_CRASH_SHOWN_S = 2.0
"""Time for which a film marks a crash, s."""
_EDGE_M = 10.4
"""Distance of the stop lines from the centre, m."""


@dataclass(frozen=True)
class Frame:
    """Content of a picture with V vehicles."""

    time_s: float
    nose: NDArray[np.float64]
    """(V, 2) front of each vehicle, m from the centre."""
    tail: NDArray[np.float64]
    """(V, 2) rear of each vehicle, m from the centre."""
    speed: NDArray[np.float64]
    """(V,) speed, m/s."""
    automated: NDArray[np.bool_]
    """(V,) whether the vehicle is automated."""
    crashes: tuple[Point, ...] = ()
    """Positions of recent crashes, m from the centre."""
    collisions: int = 0
    """Number of collisions in this episode so far."""
    left: int = 0
    """Number of vehicles that have left in this episode."""


def frame_of(env: IntersectionBatchedEnv) -> Frame:
    """Return the current state, with the crashes of the last step."""
    bridge, counters = env.bridge, env.counters
    roster, network = bridge.roster, bridge.network
    traffic, count = roster.traffic, len(roster)
    ways = list(zip(traffic.link[:count].tolist(), traffic.position[:count].tolist(), strict=True))
    nose = [network.place(link, at) for link, at in ways]
    tail = [network.place(link, max(at - _LENGTH_M, 0.0)) for link, at in ways]
    return Frame(
        time_s=counters.steps * STEP_S,
        nose=np.array(nose).reshape(count, 2),
        tail=np.array(tail).reshape(count, 2),
        speed=traffic.speed[:count].copy(),
        automated=traffic.slot[:count] >= 0,
        crashes=tuple(env.crash_places),
        collisions=counters.crashes,
        left=counters.arrived,
    )


class Camera:
    """Takes a frame of an environment after every step; crashes stay marked for two seconds."""

    def __init__(self, env: IntersectionBatchedEnv) -> None:
        self._env = env
        self._marks: list[tuple[float, Point]] = []

    def frame(self) -> Frame:
        """Return the current state, with the crashes of the last two seconds."""
        now = frame_of(self._env)
        self._marks = [mark for mark in self._marks if now.time_s - _CRASH_SHOWN_S <= mark[0] < now.time_s]
        self._marks += [(now.time_s, place) for place in now.crashes]
        return replace(now, crashes=tuple(place for _, place in self._marks))


class IntersectionRenderer:
    """Renderer of the intersection; implements `headway.contracts.Renderer`."""

    def __init__(self, prepared: object) -> None:
        """`prepared` is passed to every renderer; all intersections are drawn alike."""
        self._camera: Camera | None = None
        self._last: NDArray[np.uint8] | None = None

    def render(self, env: BatchedEnv, at_end: bool) -> NDArray[np.uint8]:
        """Return an RGB picture (height, width, 3). Raises TypeError for any other environment.

        With `at_end`, show the step before the last, because SUMO has already discarded the episode.
        """
        if not isinstance(env, IntersectionBatchedEnv):
            raise TypeError(
                f"the picture of an intersection needs an IntersectionBatchedEnv, not {type(env).__name__}"
            )
        if at_end and self._last is not None:
            return self._last
        if self._camera is None:
            self._camera = Camera(env)
        self._last = render(self._camera.frame())
        return self._last


def render(frame: Frame, size: int = 640, reach_m: float = 80.0) -> NDArray[np.uint8]:
    """Return an RGB picture (size, size, 3) of the area within `reach_m` of the centre: human drivers white,
    automated vehicles from violet (standing) to blue (20 m/s), crashes as red rings."""
    pixels = size * _SCALE
    canvas = Image.new("RGB", (pixels, pixels), GRASS)
    pen = ImageDraw.Draw(canvas)
    per_m = pixels / (2 * reach_m)

    def at(x: float, y: float) -> Point:
        return (x + reach_m) * per_m, (reach_m - y) * per_m

    _draw_roads(pen, at, per_m)
    for row in range(len(frame.speed)):
        colour = _colour(float(frame.speed[row])) if frame.automated[row] else HUMAN
        pen.polygon([at(*corner) for corner in _outline(frame.nose[row], frame.tail[row])], fill=colour)
    for x, y in frame.crashes:
        box = [*at(x - 4, y + 4), *at(x + 4, y - 4)]
        pen.ellipse(box, outline=CRASH, width=round(1.2 * per_m))
    small = canvas.resize((size, size), Image.Resampling.BOX)
    _write(ImageDraw.Draw(small), frame)
    return np.asarray(small)


def _draw_roads(pen: ImageDraw.ImageDraw, at: Callable[[float, float], Point], per_m: float) -> None:
    width, edge, end = _LANES_M, _EDGE_M, ROAD_M
    for corners in (((-width, end), (width, -end)), ((-end, width), (end, -width))):
        pen.rectangle([*at(*corners[0]), *at(*corners[1])], fill=ROAD)
    thin = max(round(0.25 * per_m), 1)
    for side in (-1, 1):
        pen.line([at(0, side * edge), at(0, side * end)], fill=LINE, width=2 * thin)
        pen.line([at(side * edge, 0), at(side * end, 0)], fill=LINE, width=2 * thin)
        for lane in (-width / 2, width / 2):
            for begin in np.arange(edge, end, 6.0):
                pen.line([at(lane, side * begin), at(lane, side * (begin + 3))], fill=LINE, width=thin)
                pen.line([at(side * begin, lane), at(side * (begin + 3), lane)], fill=LINE, width=thin)
    pen.line([at(-width, edge), at(0, edge)], fill=LINE, width=2 * thin)
    pen.line([at(width, -edge), at(0, -edge)], fill=LINE, width=2 * thin)
    pen.line([at(edge, width), at(edge, 0)], fill=LINE, width=2 * thin)
    pen.line([at(-edge, -width), at(-edge, 0)], fill=LINE, width=2 * thin)


def _outline(nose: NDArray[np.float64], tail: NDArray[np.float64]) -> list[Point]:
    """Return the four corners of a vehicle."""
    along = nose - tail
    length = float(np.hypot(*along)) or 1.0
    across = np.array((-along[1], along[0])) / length * _WIDTH_M / 2
    corners = (nose + across, nose - across, tail - across, tail + across)
    return [(float(x), float(y)) for x, y in corners]


def _colour(speed: float) -> tuple[int, int, int]:
    share = min(speed / _MAX_SPEED, 1.0)
    red, green, blue = (SLOW + share * (FAST - SLOW)).astype(int).tolist()
    return red, green, blue


def _write(pen: ImageDraw.ImageDraw, frame: Frame) -> None:
    automated = int(frame.automated.sum())
    lines = [
        f"{frame.time_s:6.1f} s",
        f"{automated} automated (violet: standing, blue: 20 m/s)",
        f"{len(frame.speed) - automated} human-driven (white)",
        f"{frame.left} have left, {frame.collisions} collisions",
    ]
    for place, line in enumerate(lines):
        pen.text((8, 8 + 14 * place), line, fill=TEXT)

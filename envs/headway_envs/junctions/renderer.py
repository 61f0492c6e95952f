"""Pictures of a network with its vehicles, drawn without a window or screen."""

from math import cos, radians, sin
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from headway.contracts import BatchedEnv
from headway_envs.junctions.env import JunctionsBatchedEnv
from headway_envs.junctions.files import read_xml
from headway_envs.junctions.prepared import Prepared

Point = tuple[float, float]
SIZE = 640
_SCALE = 3
"""Factor by which pictures are drawn larger and then reduced, for smooth edges."""
_LANE_M, _LENGTH_M, _WIDTH_M, _MARGIN_M = 3.2, 5.0, 1.8, 5.0
GROUND, ROAD, TEXT = (226, 232, 222), (88, 92, 98), (30, 30, 30)
HUMAN = (236, 236, 236)
SLOW, FAST = np.array((196, 64, 196)), np.array((32, 170, 255))


class JunctionsRenderer:
    """Renderer of the junctions; implements `headway.contracts.Renderer`."""

    def __init__(self, prepared: Prepared) -> None:
        root = read_xml(Path(prepared.network.path), "network", ("net",))
        self._shapes = [
            _points(lane.attrib["shape"]) for edge in root.iter("edge") for lane in edge.iter("lane")
        ]
        corners = np.concatenate(self._shapes)
        low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
        self._middle = (low + high) / 2
        self._per_m = SIZE * _SCALE / float((high - low).max())
        self._limit = prepared.network.speed_limit
        self._last: NDArray[np.uint8] | None = None

    def render(self, env: BatchedEnv, at_end: bool) -> NDArray[np.uint8]:
        """Return an RGB picture (height, width, 3): human drivers white, automated vehicles from violet
        (standing) to blue (at the speed limit). Raises TypeError for any other environment.

        With `at_end`, show the step before the last, because SUMO has already discarded the episode.
        """
        if not isinstance(env, JunctionsBatchedEnv):
            raise TypeError(
                f"the picture of a road network needs a JunctionsBatchedEnv, not {type(env).__name__}"
            )
        if not at_end or self._last is None:
            self._last = self._draw(env)
        return self._last

    def _draw(self, env: JunctionsBatchedEnv) -> NDArray[np.uint8]:
        canvas = Image.new("RGB", (SIZE * _SCALE, SIZE * _SCALE), GROUND)
        pen, width = ImageDraw.Draw(canvas), round(_LANE_M * self._per_m)
        for shape in self._shapes:
            pen.line(
                [self._at(x, y) for x, y in shape.tolist()], fill=ROAD, width=max(width, 1), joint="curve"
            )
        traffic = env.traffic
        for name, vehicle in traffic.vehicles.items():
            x, y = traffic.simulation.sumo.vehicle.getPosition(name)
            angle = radians(traffic.simulation.sumo.vehicle.getAngle(name))
            share = min(vehicle.speed / self._limit, 1.0)
            red, green, blue = (SLOW + share * (FAST - SLOW)).astype(int).tolist()
            colour = HUMAN if vehicle.slot < 0 else (red, green, blue)
            pen.polygon([self._at(*corner) for corner in _outline(x, y, angle)], fill=colour)
        small = canvas.resize((SIZE, SIZE), Image.Resampling.BOX)
        automated = sum(vehicle.slot >= 0 for vehicle in traffic.vehicles.values())
        lines = (
            f"{env.steps_taken * env.config.step_s:6.1f} s",
            f"{automated} automated (violet: standing, blue: {self._limit:.0f} m/s)",
            f"{len(traffic.vehicles) - automated} human-driven (white)",
        )
        for place, line in enumerate(lines):
            ImageDraw.Draw(small).text((8, 8 + 14 * place), line, fill=TEXT)
        return np.asarray(small)

    def _at(self, x: float, y: float) -> Point:
        """Return the pixel of a position."""
        half, middle = SIZE * _SCALE / 2, self._middle
        return half + (x - float(middle[0])) * self._per_m, half - (y - float(middle[1])) * self._per_m


def _points(shape: str) -> NDArray[np.float64]:
    """Return the points (n, 2) of a shape, without heights."""
    return np.array([pair.split(",")[:2] for pair in shape.split()], np.float64)


def _outline(x: float, y: float, angle: float) -> list[Point]:
    """Return the four corners of a vehicle whose front is at (x, y); `angle`: clockwise from north."""
    along, half = (sin(angle) * _LENGTH_M, cos(angle) * _LENGTH_M), _WIDTH_M / 2
    across = (cos(angle) * half, -sin(angle) * half)
    tail = (x - along[0], y - along[1])
    return [
        (x + across[0], y + across[1]),
        (x - across[0], y - across[1]),
        (tail[0] - across[0], tail[1] - across[1]),
        (tail[0] + across[0], tail[1] + across[1]),
    ]

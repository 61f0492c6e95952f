"""Pictures of a merge: the road in two rows below a scale, its ramp lanes, and vehicles with their speeds."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from headway.contracts import BatchedEnv
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.layout import (
    CAR_LENGTH,
    CAR_WIDTH,
    LANE_WIDTH,
    OBSTACLE_SIZE,
    STEP_S,
    SUBSTEPS,
)
from headway_envs.merge.network import END
from headway_envs.merge.prepared import Prepared

Pixels = list[tuple[float, float]]

ROW_M = 270.0
"""Length of road per row, m; two rows show all of it."""
SCALE = 5.0
"""Scale of pictures, pixels per metre."""
FINER = 2
"""Factor by which pictures are drawn larger and then reduced, for smooth edges."""
ABOVE_M, MARGIN_M, HEADER = 10.0, 4.0, 34
NAME_M = 2.0
"""Distance of a road's name from its edge, m: vehicles do not cover it."""
TICK_M = 50.0
"""Distance between the marks of the scale above each row, m."""
NAMED_AT_M = (25.0, ROW_M + 190.0)
"""Places at which the main road is named, one per row, m; the ramp is named at the first."""

GROUND, ROAD, MARKING, EDGE, TEXT = "#eef1ea", "#8d949b", "#ffffff", "#54595e", "#20242a"
CAV, HUMAN, CRASHED, OBSTACLE = "#1565c0", "#2e9d4f", "#d32f2f", "#f2b705"


class MergeRenderer:
    """Renderer of both merging environments; implements `headway.contracts.Renderer`."""

    def __init__(self, prepared: Prepared) -> None:
        lanes = prepared.network.lanes
        self._lanes, self._obstacles = lanes, prepared.network.obstacles
        self._ramp_lanes = prepared.ramp_lanes
        self._row_m = float(lanes["y"].max()) + LANE_WIDTH / 2.0 + ABOVE_M + MARGIN_M
        self._size = int(ROW_M * SCALE), int(HEADER + 2 * self._row_m * SCALE)
        self._font = ImageFont.load_default(11 * FINER)
        self._large = ImageFont.load_default(15 * FINER)
        self._background = self._draw_road()

    def render(self, env: BatchedEnv, at_end: bool) -> NDArray[np.uint8]:
        """Return an RGB picture (height, width, 3). Raises TypeError for any other environment."""
        if not isinstance(env, MergeBatchedEnv):
            raise TypeError(f"the picture of a merge needs a MergeBatchedEnv, not {type(env).__name__}")
        outputs, world = env.outputs, env.world
        episode = (outputs.final_episodes if at_end else world.episodes)[0]
        cars = (outputs.final_cars if at_end else world.cars)[0][: episode["cars"]]
        picture = self._background.copy()
        draw = ImageDraw.Draw(picture)
        for index, car in enumerate(cars):
            self._draw_car(draw, car, CAV if index < episode["cavs"] else HUMAN)
        speeds, merged = cars["speed"][: episode["cavs"]], int(cars["merged"][: episode["cavs"]].sum())
        line = f"{episode['step'] * SUBSTEPS * STEP_S:5.1f} s    CAVs: mean speed {speeds.mean():.1f} m/s, "
        line += f"{merged} of {len(speeds)} past the ramp    reward so far {episode['reward']:.1f}"
        if episode["crash"]:
            line += "    CRASH"
        draw.text((8 * FINER, 8 * FINER), line, TEXT, self._large)
        small = picture.resize(self._size, Image.Resampling.LANCZOS)
        return np.asarray(small, np.uint8)

    def _at(self, x: float, y: float) -> tuple[float, float]:
        """Return the pixel coordinates of a position on the road."""
        row = min(int(x // ROW_M), 1) if x >= 0.0 else 0
        across = HEADER + (row * self._row_m + ABOVE_M + y) * SCALE
        return (x - row * ROW_M) * SCALE * FINER, across * FINER

    def _draw_road(self) -> Image.Image:
        picture = Image.new("RGB", (self._size[0] * FINER, self._size[1] * FINER), GROUND)
        draw = ImageDraw.Draw(picture)
        for half, colour in ((LANE_WIDTH / 2.0 + 0.25, EDGE), (LANE_WIDTH / 2.0, ROAD)):
            for lane in self._lanes:
                self._draw_lane(draw, lane, half, colour)
        for index, lane in enumerate(self._lanes):
            if index > lane["first"]:
                for x in np.arange(lane["x"], lane["x"] + lane["length"], 8.0):
                    y = lane["y"] - LANE_WIDTH / 2.0
                    draw.line([self._at(x, y), self._at(x + 4.0, y)], MARKING, FINER)
        if self._ramp_lanes == 2:  # no changes between the ramp lanes before they run along the highway
            for lane in self._lanes[-2:]:
                for upper, _ in self._edges(lane, LANE_WIDTH / 2.0):
                    draw.line(upper, MARKING, FINER)
        half = OBSTACLE_SIZE / 2.0
        for x, y in self._obstacles:
            draw.rectangle([self._at(x - half, y - half), self._at(x + half, y + half)], OBSTACLE, EDGE)
        self._draw_names(draw)
        for row in range(2):
            self._draw_scale(draw, row)
        self._draw_legend(draw)
        return picture

    def _draw_lane(self, draw: ImageDraw.ImageDraw, lane: np.void, half: float, colour: str) -> None:
        for upper, lower in self._edges(lane, half):
            draw.polygon([*upper, *reversed(lower)], colour)

    def _edges(self, lane: np.void, half: float) -> Iterator[tuple[Pixels, Pixels]]:
        """Yield the lines `half` m to the left and right of a lane's centre, for each row the lane is in."""
        end = lane["x"] + lane["length"]
        if end == END:  # vehicles drive on
            end = 2.0 * ROW_M
        for row in range(2):
            begin, stop = max(lane["x"], row * ROW_M), min(end, (row + 1) * ROW_M)
            if stop <= begin:
                continue
            x = np.linspace(begin, stop, 60)
            bend = np.sin(lane["pulsation"] * (x - lane["x"]) + lane["phase"])
            centre = lane["y"] + lane["amplitude"] * bend
            # A position at the end of a row would be drawn in the next row.
            x = np.minimum(x, (row + 1) * ROW_M - 1e-6)
            yield (
                [self._at(a, b - half) for a, b in zip(x, centre, strict=True)],
                [self._at(a, b + half) for a, b in zip(x, centre, strict=True)],
            )

    def _draw_names(self, draw: ImageDraw.ImageDraw) -> None:
        """Write what the roads are beside them, each name with an arrow in driving direction."""
        ramp = max(lane["y"] for lane in self._lanes if lane["closed"] and lane["x"] == 0.0)
        beside = LANE_WIDTH / 2.0 + NAME_M
        names = [("main road", at, float(self._lanes["y"].min()) - beside) for at in NAMED_AT_M]
        names.append(("ramp", NAMED_AT_M[0], ramp + beside))
        for name, at, across in names:
            x, y = self._at(at, across)
            draw.text((x, y), name, TEXT, self._font, anchor="lm")
            x += draw.textlength(name, self._font) + 6 * FINER
            tip = x + 18 * FINER
            draw.line([(x, y), (tip, y)], TEXT, FINER)
            draw.polygon([(tip, y), *((tip - 6 * FINER, y + side * 3 * FINER) for side in (-1, 1))], TEXT)
        x, y = self._obstacles[-1]
        draw.text(self._at(x + OBSTACLE_SIZE, y), "end of the ramp", TEXT, self._font, anchor="lm")

    def _draw_scale(self, draw: ImageDraw.ImageDraw, row: int) -> None:
        """Draw the distances above a row, m along the main road, and say how the rows join."""
        begin, end = row * ROW_M, (row + 1) * ROW_M
        y = (HEADER + row * self._row_m * SCALE + 13) * FINER
        draw.line([(0, y), (self._size[0] * FINER, y)], EDGE, FINER)
        for metres in np.arange(np.ceil(begin / TICK_M) * TICK_M, end, TICK_M):
            x = (metres - begin) * SCALE * FINER
            draw.line([(x, y), (x, y + 4 * FINER)], EDGE, FINER)
            if abs(metres - ROW_M) > 0.8 * TICK_M:  # there it is said how the rows join
                anchor = "ms" if metres else "ls"
                draw.text((x or 4 * FINER, y - 3 * FINER), f"{metres:.0f} m", EDGE, self._font, anchor=anchor)
        if row == 0:
            x, said, anchor = self._size[0] - 4, f"{end:.0f} m, continued below", "rs"
        else:
            x, said, anchor = 4, f"{begin:.0f} m, continued from above", "ls"
        draw.text((x * FINER, y - 3 * FINER), said, EDGE, self._font, anchor=anchor)

    def _draw_legend(self, draw: ImageDraw.ImageDraw) -> None:
        x = self._size[0] * FINER - 330 * FINER
        for name, colour in (("CAV", CAV), ("human driver", HUMAN), ("crashed", CRASHED)):
            draw.rectangle([x, 10 * FINER, x + 22 * FINER, 19 * FINER], colour, EDGE)
            draw.text((x + 28 * FINER, 8 * FINER), name, TEXT, self._font)
            x += (50 + 7 * len(name)) * FINER
        x = self._size[0] * FINER - 350 * FINER
        draw.text((x, 8 * FINER), "numbers: speeds, m/s", TEXT, self._font, anchor="ra")

    def _draw_car(self, draw: ImageDraw.ImageDraw, car: np.void, colour: str) -> None:
        if not 0.0 <= car["x"] < 2.0 * ROW_M:
            return
        x, y = self._at(car["x"], car["y"])
        corners = []
        for along, across in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            u, w = along * CAR_LENGTH / 2.0 * SCALE * FINER, across * CAR_WIDTH / 2.0 * SCALE * FINER
            corners.append((x + car["cosine"] * u - car["sine"] * w, y + car["sine"] * u + car["cosine"] * w))
        draw.polygon(corners, CRASHED if car["crashed"] else colour, EDGE)
        label = f"{car['speed']:.0f}"
        draw.text((x, y - CAR_WIDTH * SCALE * FINER), label, TEXT, self._font, anchor="mb")

"""Thinned learning curves for MLflow: points of durable rows only, each once."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from headway.events import Row


@dataclass(frozen=True, slots=True)
class Point:
    """One value of one metric."""

    metric: str
    value: float
    step: int
    """Environment steps, the common axis of runs of different algorithms."""
    wall_s: float
    """Seconds since the run started."""


class ThinnedCurve:
    """Thinned learning curve of a run: at most `points` points per metric over a budget of `iterations`.

    The budget is split into intervals of equal length, and the last iteration is a separate interval; the
    first point of each metric in each interval is kept. The selection does not depend on when rows arrive.
    """

    def __init__(self, iterations: int, points: int) -> None:
        self._iterations = max(iterations, 1)
        self._intervals = points - 1
        self._last_interval: dict[str, int] = {}

    def points(self, rows: Iterable[Row], sent: Mapping[str, frozenset[int]]) -> list[Point]:
        """Return the points of further rows, except at the steps in `sent`, by metric.

        Rows (`iteration`, `env_steps`, `wall_s`, metrics) come in the order of their iterations. Metrics are
        the columns named `group/name`.
        """
        return [
            point
            for row in rows
            for point in self._kept(row)
            if point.step not in sent.get(point.metric, frozenset())
        ]

    def _kept(self, row: Row) -> list[Point]:
        iteration = int(row["iteration"])
        interval = iteration * self._intervals // self._iterations
        points = []
        for metric, value in row.items():
            if "/" not in metric or isinstance(value, str):
                continue
            if self._last_interval.get(metric, -1) >= interval:
                continue
            self._last_interval[metric] = interval
            step, wall_s = int(row["env_steps"]), float(row["wall_s"])
            points.append(Point(metric, float(value), step, wall_s))
        return points

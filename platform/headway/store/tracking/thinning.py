"""Which points of a curve go to MLflow: a thinned copy, of durable rows only, each once."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from headway.events import Row


@dataclass(frozen=True, slots=True)
class Point:
    """One value of one metric."""

    metric: str
    value: float
    step: int
    """Environment steps, the axis that runs of different algorithms share."""
    wall_s: float
    """Seconds since the run started."""


class ThinnedCurve:
    """Splits the `iterations` of a run's budget into `points` stretches and keeps, of each metric, the
    first point in each stretch; the last iteration is a stretch of its own, so its point is always kept.
    The choice depends on the rows alone, not on when they came."""

    def __init__(self, iterations: int, points: int) -> None:
        self._iterations = max(iterations, 1)
        self._stretches = points - 1
        self._taken: dict[str, int] = {}
        self._waiting: list[Row] = []

    def add(self, rows: Iterable[Row]) -> None:
        """Take rows (`iteration`, `env_steps`, `wall_s`, metrics), in the order of their iterations.
        Metrics are the columns named `group/name`."""
        self._waiting.extend(rows)

    def durable(self, iteration: int, sent: Mapping[str, frozenset[int]] | None = None) -> list[Point]:
        """The points up to `iteration` that are not yet sent; `sent` names steps already at MLflow."""
        ready = [row for row in self._waiting if int(row.get("iteration", 0)) <= iteration]
        self._waiting = [row for row in self._waiting if int(row.get("iteration", 0)) > iteration]
        known = sent or {}
        return [
            point
            for row in ready
            for point in self._kept(row)
            if point.step not in known.get(point.metric, frozenset())
        ]

    def _kept(self, row: Row) -> list[Point]:
        iteration = int(row.get("iteration", 0))
        stretch = iteration * self._stretches // self._iterations
        points = []
        for metric, value in row.items():
            if "/" not in metric or isinstance(value, str) or self._taken.get(metric, -1) >= stretch:
                continue
            self._taken[metric] = stretch
            step, wall_s = int(row.get("env_steps", iteration)), float(row.get("wall_s", 0.0))
            points.append(Point(metric, float(value), step, wall_s))
        return points

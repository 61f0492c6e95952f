"""How MLflow follows one run's folder: live, after a resume, or long afterwards."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from headway.config import StoreConfig
from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.checkpoint import latest_iteration
from headway.store.curve import ThinnedCurve
from headway.store.durable import read_json, write_json
from headway.store.folder import CHECKPOINTS, RunRecord, now, read_summary, run_folders
from headway.store.log import read_rows
from headway.store.tracking import Tracker

_STATE = "tracking.json"
_FILES = ("config.yaml", "plan.json", "run.json", "summary.json", "*.parquet", "*.png", "*.svg", "*.html")


class RunFollower:
    """Brings MLflow up to date with the run in `directory`. Used from one thread."""

    def __init__(self, directory: Path, curve_points: int) -> None:
        self.directory = directory
        self._curve_points = curve_points
        self._record = RunRecord.read(directory)
        self._curve = ThinnedCurve(self._record.iterations, curve_points)
        self._child = ""

    def begin(self, tracker: Tracker) -> None:
        """Find or create the run in MLflow, and send what its folder holds already."""
        record = self._record
        experiment, parent = tracker.cell(record.study, record.cell, record.parameters, _cell_tags(record))
        self._child = tracker.child(
            experiment, parent, record.run_id, record.started, record.parameters, _run_tags(record)
        )
        state = {"uri": tracker.uri, "experiment": experiment, "parent": parent, "run": self._child}
        write_json(self.directory / _STATE, state | {"complete": False})
        iteration = _durable_iteration(self.directory, record)
        curve = read_rows(self.directory, "curve")
        rows = [row for row in curve if int(row.get("iteration", 0)) <= iteration]
        if rows:
            self._curve.add(rows)
            sent = tracker.sent_steps(self._child)
            tracker.points(self._child, record.started, self._curve.durable(iteration, sent))

    def advance(self, tracker: Tracker, rows: Iterable[Row], iteration: int) -> None:
        """Take new rows and send the points up to `iteration`, which the run's log holds durably."""
        self._curve.add(rows)
        tracker.points(self._child, self._record.started, self._curve.durable(iteration))

    def tag(self, tracker: Tracker, name: str, text: str) -> None:
        """Set a tag of the run."""
        tracker.tag(self._child, name, text)

    def complete(self, tracker: Tracker) -> None:
        """Send the summary, the files and the status of a run that has ended."""
        record = RunRecord.read(self.directory)
        files = sorted(file for pattern in _FILES for file in self.directory.glob(pattern))
        figures = _figures(read_summary(self.directory))
        tracker.finish(self._child, record.settled_status, record.ended or now(), figures, files)
        write_json(self.directory / _STATE, read_json(self.directory / _STATE) | {"complete": True})


def sync(
    root: Path, tracking_uri: str | None = None, curve_points: int = StoreConfig.curve_points
) -> tuple[str, ...]:
    """Bring MLflow up to date with every run folder under `root`, but those whose session still runs.

    Safe to repeat: nothing is sent twice. Returns one line for each run brought up to date or unreadable.
    Raises HeadwayError if MLflow fails.
    """
    lines = []
    tracker: Tracker | None = None
    for directory in sorted(run_folders(root)):
        try:
            record = RunRecord.read(directory)
        except HeadwayError as error:
            lines.append(str(error))
            continue
        if record.settled_status == "RUNNING":
            continue
        tracker = tracker or Tracker(root, tracking_uri)
        if _is_complete(directory, tracker.uri):
            continue
        follower = RunFollower(directory, curve_points)
        follower.begin(tracker)
        follower.complete(tracker)
        lines.append(f"{record.run_id} is up to date in MLflow")
    return tuple(lines)


def _is_complete(directory: Path, uri: str) -> bool:
    if not (directory / _STATE).exists():
        return False
    state = read_json(directory / _STATE)
    return bool(state.get("complete")) and state.get("uri") == uri


def _durable_iteration(directory: Path, record: RunRecord) -> int:
    # A session killed with its run may have missed the last checkpoints; the folder knows them.
    latest = latest_iteration(directory / CHECKPOINTS) or 0
    return max(latest, record.durable_iteration)


def _cell_tags(record: RunRecord) -> dict[str, str]:
    return {"environment": record.environment, "algorithm": record.algorithm}


def _run_tags(record: RunRecord) -> dict[str, str]:
    return {**record.tags, **_cell_tags(record), "seed": str(record.seed), "policies": record.policies}


def _figures(summary: Mapping[str, Any]) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in summary.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }

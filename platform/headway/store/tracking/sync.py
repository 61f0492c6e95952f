"""How MLflow follows one run's folder: live, after a resume, or long afterwards."""

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.atomic_files import locked, read_json, write_json
from headway.store.checkpoint import latest_iteration
from headway.store.parquet_log import read_rows
from headway.store.run_folder import (
    CHECKPOINTS,
    Process,
    RunRecord,
    now,
    read_summary,
    run_folders,
    status_of_all,
)
from headway.store.tracking.client import Tracker, TrackingError, database_uri
from headway.store.tracking.thinning import ThinnedCurve

_SYNC_SECONDS = 600.0
_STATE = "tracking.json"
_FILES = (
    "config.yaml",
    "plan.json",
    "run.json",
    "summary.json",
    "*.parquet",
    "*.csv",
    "*.png",
    "*.svg",
    "*.html",
)


class RunFollower:
    """Brings MLflow up to date with the run in `directory`. Used from one thread."""

    def __init__(self, directory: Path, curve_points: int) -> None:
        self.directory = directory
        self._curve_points = curve_points
        self._record = RunRecord.read(directory)
        self._curve = ThinnedCurve(self._record.iterations, curve_points)
        self._child = ""
        """Its run in MLflow; empty before `begin`, and where something was not sent."""

    def begin(self, tracker: Tracker, going_on: bool = True) -> None:
        """Find or create the run in MLflow, and send what its folder holds already; `going_on`: its cell is
        trained."""
        self._record = record = RunRecord.read(self.directory)
        self._curve = ThinnedCurve(record.iterations, self._curve_points)
        experiment, parent = tracker.cell(
            record.study, record.cell, record.parameters, _cell_tags(record), going_on
        )
        child = tracker.child(
            experiment, parent, record.run_id, record.started, record.parameters, _run_tags(record)
        )
        state = {"uri": tracker.uri, "experiment": experiment, "parent": parent, "run": child}
        write_json(_state_file(self.directory, tracker.uri, tracker.local), state | {"complete": False})
        iteration = _durable_iteration(self.directory, record)
        curve = read_rows(self.directory, "curve")
        rows = [row for row in curve if int(row.get("iteration", 0)) <= iteration]
        if rows:
            self._curve.add(rows)
            tracker.points(child, record.started, self._curve.durable(iteration, tracker.sent_steps(child)))
        self._child = child

    def forget(self) -> None:
        """Something was not sent: what follows begins anew, with what the folder holds."""
        self._child = ""

    def catch_up(self, tracker: Tracker) -> None:
        """Send all that is missing."""
        ended = RunRecord.read(self.directory).settled_status != "RUNNING"
        self.begin(tracker, going_on=not ended)
        if ended:
            self.complete(tracker)

    def advance(self, tracker: Tracker, rows: Iterable[Row], iteration: int) -> None:
        """Take new rows and send the points up to `iteration`, which the run's log holds durably."""
        if not self._child:
            self.begin(tracker)
            return
        self._curve.add(rows)
        tracker.points(self._child, self._record.started, self._curve.durable(iteration))

    def tag(self, tracker: Tracker, name: str, text: str) -> None:
        """Set a tag of the run."""
        if not self._child:
            self.begin(tracker)
        tracker.tag(self._child, name, text)

    def complete(self, tracker: Tracker) -> None:
        """Send the files and the status of a run that has ended, and the summary of one that has finished:
        another's may yet change, and MLflow only appends."""
        if not self._child:
            self.begin(tracker, going_on=False)
        record = RunRecord.read(self.directory)
        files = sorted(file for pattern in _FILES for file in self.directory.glob(pattern))
        status = record.settled_status
        figures = _figures(read_summary(self.directory)) if status == "FINISHED" else {}
        tracker.finish(self._child, status, record.ended or now(), figures, files)
        path = _state_file(self.directory, tracker.uri, tracker.local)
        write_json(path, read_json(path) | {"complete": _end(record)})


def sync(root: Path, tracking_uri: str | None = None) -> tuple[str, ...]:
    """Bring MLflow (None: the database in the root) up to date with every run folder under `root`, but those
    whose session still runs.

    Safe to repeat: nothing is sent twice. Returns one line for each run brought up to date or unreadable: one
    that cannot be read keeps back no other. Raises TrackingError if MLflow fails.
    """
    runs, lines = _ended_runs(root)
    return (*lines, *_send_missing(root, tracking_uri, runs))


def sync_each(root: Path) -> tuple[str, ...]:
    """As `sync`, each run to where it was to be sent when it was trained."""
    runs, lines = _ended_runs(root)
    for uri in dict.fromkeys(record.tracking_uri for _, record in runs):
        lines += _send_missing(root, uri, [run for run in runs if run[1].tracking_uri == uri])
    return tuple(lines)


def behind(root: Path, tracking_uri: str | None) -> list[Path]:
    """Folders of ended runs that MLflow at this URI was to know of and does not know all of."""
    runs = [run for run in _ended_runs(root)[0] if run[1].tracking_uri == tracking_uri]
    return _missing(root, tracking_uri, runs)


def deliver(root: Path, tracker: Tracker) -> None:
    """Send what is `behind` at a tracker's URI. Raises TrackingError if MLflow fails, and HeadwayError for
    runs that cannot be read, after all others are sent."""
    _, unreadable = _send(root, tracker, behind(root, None if tracker.local else tracker.uri))
    if unreadable:
        raise HeadwayError("; ".join(unreadable))


def _send_missing(
    root: Path, tracking_uri: str | None, runs: Iterable[tuple[Path, RunRecord]]
) -> tuple[str, ...]:
    missing = _missing(root, tracking_uri, runs)
    if not missing:
        return ()
    sent, unreadable = _send(root, Tracker(root, tracking_uri), missing)
    return (*sent, *unreadable)


def _missing(root: Path, tracking_uri: str | None, runs: Iterable[tuple[Path, RunRecord]]) -> list[Path]:
    return [folder for folder, record in runs if not _is_complete(folder, record, root, tracking_uri)]


def _send(root: Path, tracker: Tracker, folders: Iterable[Path]) -> tuple[list[str], list[str]]:
    """A line for each run sent, and for each unreadable one. One session at a time, so that no run is created
    twice."""
    sent: list[RunRecord] = []
    unreadable: list[str] = []
    with locked(root / ".sync.lock", _SYNC_SECONDS, "MLflow was brought up to date"):
        for folder in folders:
            try:
                record = RunRecord.read(folder)
                if _is_complete(folder, record, root, None if tracker.local else tracker.uri):
                    continue
                RunFollower(folder, record.curve_points).catch_up(tracker)
                sent.append(record)
            except TrackingError:
                raise
            except HeadwayError as error:
                unreadable.append(f"{folder.name} is not sent to MLflow: {error}")
        _end_cells(root, tracker, sent)
    return [f"{record.run_id} is up to date in MLflow" for record in sent], unreadable


def _end_cells(root: Path, tracker: Tracker, sent: Iterable[RunRecord]) -> None:
    """End what MLflow has as running of the cells of runs just sent, where nobody trains them any more: a
    session that had no time to tell of its runs had none to tell of their cells."""
    of_cells: dict[tuple[str, str], list[RunRecord]] = {(run.study, run.cell): [] for run in sent}
    if not of_cells:
        return
    for folder in sorted(run_folders(root)):
        with suppress(HeadwayError):
            record = RunRecord.read(folder)
            if (runs := of_cells.get((record.study, record.cell))) is not None:
                runs.append(record)
    for runs in of_cells.values():
        newest = {run.seed: run for run in sorted(runs, key=lambda run: run.started)}.values()
        statuses = {run.settled_status for run in newest}
        if "RUNNING" in statuses:
            continue
        [*_, last] = newest
        _, parent = tracker.cell(last.study, last.cell, last.parameters, {}, going_on=False)
        ended = max(run.ended or run.started for run in newest)
        tracker.end(parent, status_of_all(statuses), ended)


def _ended_runs(root: Path) -> tuple[list[tuple[Path, RunRecord]], list[str]]:
    """Runs that no other living session may be telling MLflow of; a line for each unreadable one."""
    runs, lines = [], []
    for folder in sorted(run_folders(root)):
        try:
            record = RunRecord.read(folder)
        except HeadwayError as error:
            lines.append(str(error))
            continue
        own = record.session == Process.current()
        if record.settled_status != "RUNNING" and (own or not record.session.may_live()):
            runs.append((folder, record))
    return runs, lines


def local_experiment(folder: Path) -> str | None:
    """The experiment, in the MLflow database beside the runs, that holds the run in a folder; None where that
    database does not have it."""
    try:
        return str(read_json(folder / _STATE)["experiment"])
    except (HeadwayError, KeyError):
        return None


def _state_file(folder: Path, uri: str, local: bool) -> Path:
    """What is known of the run at one MLflow: `tracking.json` for the database in the root."""
    return folder / (_STATE if local else f"tracking-{sha256(uri.encode()).hexdigest()[:8]}.json")


def _is_complete(folder: Path, record: RunRecord, root: Path, tracking_uri: str | None) -> bool:
    uri = tracking_uri or database_uri(root)
    path = _state_file(folder, uri, tracking_uri is None)
    if not path.exists():
        return False
    try:
        state = read_json(path)
    except HeadwayError:
        return False  # MLflow is asked what it has, and the file written anew
    return state.get("uri") == uri and state.get("complete") == _end(record)


def _end(record: RunRecord) -> str:
    """Tells one end of a run from another: a run may be resumed and end again."""
    return f"{record.settled_status} {record.ended or ''} {record.durable_iteration}"


def _durable_iteration(directory: Path, record: RunRecord) -> int:
    # A session killed with its run may have missed the last checkpoints; the folder knows them.
    latest = latest_iteration(directory / CHECKPOINTS) or 0
    return max(latest, record.durable_iteration)


def _cell_tags(record: RunRecord) -> dict[str, str]:
    return {"environment": record.environment, "algorithm": record.algorithm}


def _run_tags(record: RunRecord) -> dict[str, str]:
    chosen = {"preset": record.preset, "candidate": record.candidate}
    known = {**record.tags, **_cell_tags(record), **{name: value for name, value in chosen.items() if value}}
    return {**known, "seed": str(record.seed), "policies": record.policies}


def _figures(summary: Mapping[str, Any]) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in summary.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }

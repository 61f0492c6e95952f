"""Synchronisation of run folders to MLflow, during training or any time later."""

import math
import operator
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from headway.contracts import HeadwayError
from headway.store.artifacts import write_views
from headway.store.atomic_files import locked, read_json, write_json
from headway.store.checkpoint import latest_iteration
from headway.store.index import folder_stamp
from headway.store.parquet_log import read_rows
from headway.store.run_folder import (
    CHECKPOINTS,
    RunRecord,
    cell_summary_file,
    now,
    read_summary,
    run_folders,
    status_of_all,
)
from headway.store.tracking.cells import cell_summaries, is_attended, send_cell
from headway.store.tracking.client import Tracker, TrackingError, database_uri
from headway.store.tracking.thinning import ThinnedCurve

_SYNC_SECONDS = 600.0
_STATE = "tracking.json"
_FILES = ("config.yaml", "plan.json", "run.json", "summary.json", "*.parquet")


class RunSync:
    """Synchronisation of the run in `directory` to MLflow, for use from one thread."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._child = ""
        """MLflow's identity of the run; empty before it is known, after an error and at the end."""
        self._tags: Mapping[str, str] = {}
        """Tags that MLflow has."""
        self._curve = ThinnedCurve(0, 0)
        self._sent_iteration = -1
        """Iteration up to which the curve has been sent."""
        self._stamp = ""
        """State of the folder when it was last sent; empty after an error."""

    def send(self, tracker: Tracker) -> None:
        """Send what MLflow lacks: the run and its tags, its curve up to the last checkpoint.

        For an ended run, also its files, with views of its log, and its status; for a finished one, also its
        summary. Nothing is done if the run's record has not changed since the last call.
        """
        stamp, before, self._stamp = folder_stamp(self.directory), self._stamp, ""
        if stamp == before:
            self._stamp = stamp
            return
        record = RunRecord.read(self.directory)
        ended, tags = record.settled_status != "RUNNING", _run_tags(record)
        child, self._child = self._child, ""
        sent: Mapping[str, frozenset[int]] = {}
        if not child or tags != self._tags:
            child = self._begin(tracker, record, tags, running=not ended)
            sent = tracker.sent_steps(child)
            self._tags, self._curve = tags, ThinnedCurve(record.iterations, record.curve_points)
            self._sent_iteration = -1
        self._send_curve(tracker, child, record, sent)
        if ended:
            self._finish(tracker, child, record)
        else:
            self._child = child
        path = _state_file(self.directory, tracker.uri, tracker.local)
        write_json(path, read_json(path) | {"complete": _progress(record)})
        self._stamp = stamp

    def _begin(self, tracker: Tracker, record: RunRecord, tags: Mapping[str, str], running: bool) -> str:
        """Find or create the run in MLflow, note it in the folder, and return its identity there.

        `running`: set the status of its cell's parent run to RUNNING.
        """
        experiment, parent = tracker.cell(
            record.study, record.cell, record.parameters, _cell_tags(record), running
        )
        child = tracker.child(experiment, parent, record.run_id, record.started, record.parameters, tags)
        state = {"uri": tracker.uri, "experiment": experiment, "parent": parent, "run": child}
        write_json(_state_file(self.directory, tracker.uri, tracker.local), state | {"complete": False})
        return child

    def _send_curve(
        self, tracker: Tracker, child: str, record: RunRecord, sent: Mapping[str, frozenset[int]]
    ) -> None:
        """Send the points up to the last checkpoint that are new in the log, except at steps in `sent`."""
        last = _durable_iteration(self.directory, record)
        rows = read_rows(self.directory, "curve", after=self._sent_iteration)
        durable = [row for row in rows if self._sent_iteration < int(row["iteration"]) <= last]
        if durable:
            tracker.points(child, record.started, self._curve.points(durable, sent))
            self._sent_iteration = int(durable[-1]["iteration"])

    def _finish(self, tracker: Tracker, child: str, record: RunRecord) -> None:
        matching = (file for pattern in _FILES for file in self.directory.glob(pattern))
        files = sorted(file for file in matching if file.is_file())  # copying a pipe would never end
        status = record.settled_status
        # The summary of a run that may be resumed can still change, and MLflow only appends.
        summary = _numbers(read_summary(self.directory)) if status == "FINISHED" else {}
        with TemporaryDirectory() as folder:
            views = write_views(self.directory, record.run_id, Path(folder))
            tracker.finish(child, status, record.ended or now(), summary, [*files, *views])


class Synced(NamedTuple):
    """Result of a synchronisation."""

    runs: tuple[str, ...] = ()
    """Runs brought up to their last checkpoint in MLflow, without those that were up to date before."""
    problems: tuple[str, ...] = ()
    """One line per run and cell that cannot be read."""
    attended: int = 0
    """Number of runs left out because their live session is sending them."""
    failures: tuple[str, ...] = ()
    """One line per tracking URI at which MLflow fails."""


def sync(root: Path, tracking_uri: str | None = None, only_own: bool = False) -> Synced:
    """Bring MLflow up to date with every run folder under `root`, or with those trained with `tracking_uri`.

    `tracking_uri` None: the database in the root. Safe to repeat: nothing is sent twice. Raises TrackingError
    if MLflow fails. `only_own`: what cannot be read is left out, since its URI is not known.
    """
    runs, problems = _runs(root)
    cells, more = cell_summaries(root)
    if only_own:
        problems, more = [], []
        runs = [run for run in runs if run[1].tracking_uri == tracking_uri]
        cells = [cell for cell in cells if cell.tracking_uri == tracking_uri]
    uri = tracking_uri or database_uri(root)
    lacking = [run for run in runs if not _is_complete(*run, uri, local=tracking_uri is None)]
    folders = [folder for folder, record in lacking if not is_attended(record, tracking_uri)]
    places = {
        (cell.study, cell.cell)
        for cell in cells
        if not cell.is_sent(uri) and not is_attended(cell, tracking_uri)
    }
    attended = len(lacking) - len(folders)
    if not folders and not places:
        return Synced((), (*problems, *more), attended)
    sent, unreadable = _send(root, Tracker(root, tracking_uri), folders, places)
    return Synced(tuple(sent), (*problems, *more, *unreadable), attended)


def sync_each(root: Path) -> Synced:
    """Bring MLflow up to date by `sync`, each run at the tracking URI it was trained with."""
    (runs, problems), (cells, more) = _runs(root), cell_summaries(root)
    done = Synced(problems=(*problems, *more))
    for uri in dict.fromkeys(
        [*(run[1].tracking_uri for run in runs), *(cell.tracking_uri for cell in cells)]
    ):
        try:
            there = sync(root, uri, only_own=True)
        except TrackingError as error:
            there = Synced(failures=(str(error),))
        done = Synced(*map(operator.add, done, there))
    return done


def _send(
    root: Path, tracker: Tracker, folders: Iterable[Path], cells: Iterable[tuple[str, str]]
) -> tuple[list[str], list[str]]:
    """Send runs, and end their cells and `cells`; return the runs sent and a line per unreadable run or cell.

    A lock admits one process at a time, so that no run is created twice in MLflow.
    """
    sent: list[RunRecord] = []
    unreadable: list[str] = []
    with locked(root / ".sync.lock", _SYNC_SECONDS, "MLflow was brought up to date"):
        for folder in folders:
            try:
                record = RunRecord.read(folder)
                if _is_complete(folder, record, tracker.uri, tracker.local):
                    continue
                RunSync(folder).send(tracker)
                sent.append(record)
            except TrackingError:
                raise
            except HeadwayError as error:
                unreadable.append(f"{folder.name} is not sent to MLflow: {error}")
        unreadable += _end_cells(root, tracker, {*cells, *((run.study, run.cell) for run in sent)})
    return [record.run_id for record in sent], unreadable


def _end_cells(root: Path, tracker: Tracker, places: Iterable[tuple[str, str]]) -> list[str]:
    """End the MLflow parent runs of cells, each (study, cell), unless a run of the cell is still training.

    Their summaries are sent. Returns a line per unreadable one.
    """
    cells: dict[tuple[str, str], list[RunRecord]] = {place: [] for place in places}
    unreadable: list[str] = []
    for _, record in reversed(_runs(root)[0] if cells else []):
        if (runs := cells.get((record.study, record.cell))) is not None:
            runs.append(record)
    for (study, cell), runs in cells.items():
        newest = {run.seed: run for run in runs}.values()
        statuses = {run.settled_status for run in newest}
        if "RUNNING" in statuses:
            continue
        try:
            if cell_summary_file(root, study, cell).exists():
                send_cell(root, tracker, study, cell, status_of_all(statuses) if newest else None)
            elif newest:  # a session that ended before it sent its runs did not end their cells either
                [*_, last] = newest
                _, parent = tracker.cell(last.study, last.cell, last.parameters, {}, running=False)
                ended = max(run.ended or run.started for run in newest)
                tracker.finish(parent, status_of_all(statuses), ended, {}, ())
        except TrackingError:
            raise
        except HeadwayError as error:
            unreadable.append(str(error))
    return unreadable


def _runs(root: Path) -> tuple[list[tuple[Path, RunRecord]], list[str]]:
    """Return all runs, the newest first, and one line per unreadable run."""
    runs: list[tuple[Path, RunRecord]] = []
    lines = []
    for folder in sorted(run_folders(root)):
        try:
            runs.append((folder, RunRecord.read(folder)))
        except HeadwayError as error:
            lines.append(str(error))
    return sorted(runs, key=lambda run: run[1].started, reverse=True), lines


def local_experiment(folder: Path) -> str | None:
    """Return a run's experiment in the MLflow database of its store; None if the database lacks the run."""
    try:
        return str(read_json(folder / _STATE)["experiment"])
    except (HeadwayError, KeyError):
        return None


def _state_file(folder: Path, uri: str, local: bool) -> Path:
    """Return the file with the run's state at one tracking URI; `tracking.json` for the local database."""
    return folder / (_STATE if local else f"tracking-{sha256(uri.encode()).hexdigest()[:8]}.json")


def _is_complete(folder: Path, record: RunRecord, uri: str, local: bool) -> bool:
    try:
        state = read_json(_state_file(folder, uri, local))
    except HeadwayError:
        return False  # missing, or broken: the run is sent again, which rewrites the file
    return state.get("uri") == uri and state.get("complete") == _progress(record)


def _progress(record: RunRecord) -> str:
    """Return a text that changes whenever there is more to send, also if a resumed run ends again."""
    return f"{record.settled_status} {record.ended or ''} {record.durable_iteration}"


def _durable_iteration(directory: Path, record: RunRecord) -> int:
    # A session killed with its run may not have recorded the last checkpoints.
    latest = latest_iteration(directory / CHECKPOINTS) or 0
    return max(latest, record.durable_iteration)


def _cell_tags(record: RunRecord) -> dict[str, str]:
    return {"environment": record.environment, "algorithm": record.algorithm}


def _run_tags(record: RunRecord) -> dict[str, str]:
    chosen = {"preset": record.preset, "candidate": record.candidate}
    known = {**record.tags, **_cell_tags(record), **{name: value for name, value in chosen.items() if value}}
    return {**known, "seed": str(record.seed), "policies": record.policies}


def _numbers(summary: Mapping[str, Any]) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in summary.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }

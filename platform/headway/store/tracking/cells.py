"""Rule returns, session energy and status of a cell: stored beside its runs and sent to its MLflow run."""

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Self

from headway.config.experiment import without_password
from headway.config.schema import build
from headway.contracts import HeadwayError
from headway.store.atomic_files import locked, read_json, write_json
from headway.store.run_folder import Process, RunRecord, Status, cell_summary_file, milliseconds
from headway.store.tracking.client import Tracker

_LOCK_SECONDS = 30.0


@dataclass(frozen=True)
class CellSummary:
    """Contents of a cell's summary file, which the session that ends the cell writes."""

    study: str
    cell: str
    parameters: Mapping[str, str]
    session: Process
    tracking_uri: str | None
    status: Status
    ended: str
    """UTC, ISO 8601."""
    metrics: Mapping[str, float] = field(default_factory=dict)
    """Mean returns of the rules, and the energy of the last session that trained the cell."""
    sent: tuple[str, ...] = ()
    """URIs, without passwords, of the MLflow servers and databases that have it."""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a summary file. Raises HeadwayError if it is broken."""
        try:
            summary = build(cls, read_json(path))
            milliseconds(summary.ended)
        except (HeadwayError, ValueError, OverflowError) as error:
            raise HeadwayError(f"{path} is not the summary of a cell ({error}): remove it") from error
        return summary

    def keep(self, root: Path) -> None:
        """Write the file, keeping the metrics that it holds already. Raises HeadwayError if that fails."""
        path = cell_summary_file(root, self.study, self.cell)
        finite = {name: value for name, value in self.metrics.items() if math.isfinite(value)}
        with _locked(root):
            known = CellSummary.read(path).metrics if path.exists() else {}
            write_json(path, asdict(replace(self, metrics={**known, **finite})))

    def is_sent(self, uri: str) -> bool:
        """Return whether the MLflow at a tracking URI has it."""
        return without_password(uri) in self.sent


def send_cell(root: Path, tracker: Tracker, study: str, cell: str, status: Status | None = None) -> None:
    """Send a cell's summary and end its parent run in MLflow, with `status` or by default the stored one.

    Values that MLflow has are not sent again. Raises HeadwayError if the file is missing or broken.
    """
    path = cell_summary_file(root, study, cell)
    summary = CellSummary.read(path)
    _, parent = tracker.cell(study, cell, summary.parameters, {}, running=False)
    tracker.finish(parent, status or summary.status, summary.ended, summary.metrics, ())
    with _locked(root):
        now = CellSummary.read(path)
        if replace(now, sent=()) == replace(summary, sent=()):  # no other session has changed it meanwhile
            sent = sorted({*now.sent, without_password(tracker.uri)})
            write_json(path, asdict(replace(now, sent=tuple(sent))))


def _locked(root: Path) -> AbstractContextManager[None]:
    return locked(root / ".cells.lock", _LOCK_SECONDS, "the summary of a cell was written")


def is_attended(sent: CellSummary | RunRecord, target: str | None) -> bool:
    """Return whether another live session may be sending a run or cell to `target`.

    Sessions send to servers only; `target` None is the store's own database.
    """
    if target is None or sent.tracking_uri is None or sent.tracking_uri.rstrip("/") != target.rstrip("/"):
        return False
    return sent.session != Process.current() and sent.session.may_live()


def cell_summaries(root: Path) -> tuple[list[CellSummary], list[str]]:
    """Return the summaries of all cells, and one line per unreadable file."""
    summaries, lines = [], []
    for path in sorted(root.glob("*/*.summary.json")):
        try:
            summaries.append(CellSummary.read(path))
        except HeadwayError as error:
            lines.append(str(error))
    return summaries, lines

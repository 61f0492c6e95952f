"""The summary index: one row a run, kept in SQLite beside the runs and derived from their folders alone.

Each query compares the folders' `run.json` and `summary.json` with what was last seen and reads the changed
ones again, so the index needs no repair: lost, stale or corrupt, it is made anew.
"""

import math
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

from headway.contracts import HeadwayError
from headway.store.run_folder import (
    RECORD,
    SUMMARY,
    Process,
    RunRecord,
    Status,
    read_summary,
    run_folders,
    settled,
)

_NAME = "index.sqlite"
_VERSION = 4
_WAIT_SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class RunRow:
    """One run at a glance; None where a figure is not known (yet)."""

    study: str
    environment: str
    algorithm: str
    policies: str
    preset: str
    """Empty where it is not known."""
    cell: str
    """The same for all seeds of one environment, algorithm and parameters."""
    seed: int
    status: Status
    iterations: int
    """Iterations done, as far as durable."""
    env_steps: int
    final_reward: float | None
    auc: float | None
    cpu_seconds: float | None
    """Of its training process and workers, in all sessions."""
    kwh: float | None
    kg_co2: float | None
    started: str
    duration_s: float
    run_id: str
    directory: str
    host: str
    pid: int
    created: float
    """With `host` and `pid`: the session process."""


_COLUMNS = tuple(item.name for item in fields(RunRow))


class RunIndex:
    """Summaries of the runs under `root`. Any number of processes may use it at once."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.notices: list[str] = []
        """One line for each run folder that could not be read at the last query."""

    def rows(self, study: str | None = None) -> list[RunRow]:
        """All runs (of a study), the oldest first; a run whose session is gone counts as KILLED."""
        self.notices = []
        if not self.root.is_dir():
            return []
        try:
            rows = self._query(self.root / _NAME)
        except sqlite3.OperationalError:
            # Locked for long, or a folder that may not be written: answer without keeping the answer.
            rows = self._query(Path(":memory:"))
        except sqlite3.DatabaseError:
            for suffix in ("", "-journal"):
                (self.root / f"{_NAME}{suffix}").unlink(missing_ok=True)
            rows = self._query(self.root / _NAME)
        now = (_settled(row) for row in rows)
        return [row for row in now if study is None or row.study == study]

    def _query(self, path: Path) -> list[RunRow]:
        with closing(sqlite3.connect(path, timeout=_WAIT_SECONDS, isolation_level=None)) as database:
            _prepare(database)
            self._refresh(database)
            found = database.execute(f"SELECT {','.join(_COLUMNS)} FROM runs ORDER BY started, run_id")
            return [RunRow(*values) for values in found]

    def _refresh(self, database: sqlite3.Connection) -> None:
        seen = dict(database.execute("SELECT directory, stamp FROM runs"))
        present = {str(folder): _stamp(folder) for folder in run_folders(self.root)}
        changed = {name: stamp for name, stamp in present.items() if seen.get(name) != stamp}
        gone = [name for name in seen if name not in present]
        if not changed and not gone:
            return
        values = list(self._changed_values(changed))
        slots = ",".join("?" * (len(_COLUMNS) + 1))
        database.execute("BEGIN IMMEDIATE")
        database.executemany("DELETE FROM runs WHERE directory = ?", [(name,) for name in gone])
        database.executemany(f"INSERT OR REPLACE INTO runs VALUES ({slots})", values)
        database.execute("COMMIT")

    def _changed_values(self, changed: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        for name, stamp in changed.items():
            try:
                yield (*astuple(_row(Path(name))), stamp)
            except HeadwayError as error:
                self.notices.append(str(error))


def _prepare(database: sqlite3.Connection) -> None:
    version = database.execute("PRAGMA user_version").fetchone()[0]
    if version == _VERSION:
        return
    database.execute("BEGIN IMMEDIATE")
    database.execute("DROP TABLE IF EXISTS runs")
    database.execute(f"CREATE TABLE runs ({','.join(_COLUMNS)}, stamp, PRIMARY KEY (directory))")
    database.execute(f"PRAGMA user_version = {_VERSION}")
    database.execute("COMMIT")


def _stamp(folder: Path) -> str:
    parts = []
    for name in (RECORD, SUMMARY):
        with suppress(FileNotFoundError):
            status = os.stat(folder / name)  # noqa: PTH116 - twice as fast as Path.stat over many runs
            parts.append(f"{status.st_mtime_ns}:{status.st_size}:{status.st_ino}")
    return " ".join(parts)


def _row(folder: Path) -> RunRow:
    record, summary = RunRecord.read(folder), read_summary(folder)
    return RunRow(
        study=record.study,
        environment=record.environment,
        algorithm=record.algorithm,
        policies=record.policies,
        preset=record.preset,
        cell=record.cell,
        seed=record.seed,
        status=record.status,
        iterations=record.durable_iteration,
        env_steps=record.durable_env_steps,
        final_reward=_figure(summary, "final_reward"),
        auc=_figure(summary, "auc"),
        cpu_seconds=_figure(summary, "cpu_seconds"),
        kwh=_figure(summary, "kwh"),
        kg_co2=_figure(summary, "kg_co2"),
        started=record.started,
        duration_s=record.duration_s,
        run_id=record.run_id,
        directory=str(folder),
        host=record.session.host,
        pid=record.session.pid,
        created=record.session.created,
    )


def _figure(summary: Mapping[str, Any], name: str) -> float | None:
    value = summary.get(name)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _settled(row: RunRow) -> RunRow:
    return replace(row, status=settled(row.status, Process(row.host, row.pid, row.created)))

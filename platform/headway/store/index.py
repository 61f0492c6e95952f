"""Summary index: one row per run, cached in SQLite in the store's root and derived from the run folders only.

Each query compares the size and time of every `run.json` and `summary.json` with the stored ones and reads
the changed files again. The index needs no repair: if it is lost, stale or corrupt, it is rebuilt.
"""

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
    study_folder,
)

_NAME = "index.sqlite"
_VERSION = 4
_WAIT_SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class RunRow:
    """Summary of one run; None: not known yet."""

    study: str
    environment: str
    algorithm: str
    policies: str
    preset: str
    """Hyper-parameter preset; empty if unknown."""
    cell: str
    """Key of the cell: the same for all seeds of one environment, algorithm and set of parameters."""
    seed: int
    status: Status
    iterations: int
    """Number of durable iterations."""
    env_steps: int
    final_reward: float | None
    auc: float | None
    cpu_seconds: float | None
    """CPU time of the training process and its workers, over all sessions."""
    kwh: float | None
    kg_co2: float | None
    started: str
    duration_s: float
    run_id: str
    directory: str
    host: str
    pid: int
    created: float
    """Start of the session process, seconds since 1970; identifies it together with `host` and `pid`."""


_COLUMNS = tuple(item.name for item in fields(RunRow))


class RunIndex:
    """Summaries of the runs under `root`. Several processes may use it at the same time."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.notices: dict[Path, str] = {}
        """By folder, the error of each run of the last query whose record or summary could not be read."""

    def rows(self, study: str | None = None) -> list[RunRow]:
        """Return all runs, or those of a study, oldest first.

        Runs without a readable record and summary are in `notices` instead. A run whose session process has
        ended counts as KILLED.
        """
        self.notices = {}
        if not self.root.is_dir():
            return []
        try:
            rows = self._query(self.root / _NAME)
        except sqlite3.OperationalError:
            # The database stayed locked or the folder is read-only: build the index in memory.
            rows = self._query(Path(":memory:"))
        except sqlite3.DatabaseError:
            for suffix in ("", "-journal"):
                (self.root / f"{_NAME}{suffix}").unlink(missing_ok=True)
            rows = self._query(self.root / _NAME)
        if study is not None:
            folder = study_folder(self.root, study)
            self.notices = {run: line for run, line in self.notices.items() if run.parent == folder}
        current = (
            replace(row, status=settled(row.status, Process(row.host, row.pid, row.created))) for row in rows
        )
        return [row for row in current if study is None or row.study == study]

    def _query(self, path: Path) -> list[RunRow]:
        with closing(sqlite3.connect(path, timeout=_WAIT_SECONDS, isolation_level=None)) as database:
            _prepare(database)
            self._refresh(database)
            found = database.execute(f"SELECT {','.join(_COLUMNS)} FROM runs ORDER BY started, run_id")
            return [RunRow(*values) for values in found]

    def _refresh(self, database: sqlite3.Connection) -> None:
        seen = dict(database.execute("SELECT directory, stamp FROM runs"))
        present = {str(folder): folder_stamp(folder) for folder in run_folders(self.root)}
        changed = {name: stamp for name, stamp in present.items() if seen.get(name) != stamp}
        gone = [name for name in seen if name not in present]
        if not changed and not gone:
            return
        values = list(self._changed_values(changed))
        gone += map(str, self.notices)
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
                self.notices[Path(name)] = str(error)


def _prepare(database: sqlite3.Connection) -> None:
    if _is_current(database):
        return
    database.execute("BEGIN IMMEDIATE")
    # Another process may have made the table, and read it, while this one waited.
    if not _is_current(database):
        database.execute("DROP TABLE IF EXISTS runs")
        database.execute(f"CREATE TABLE runs ({','.join(_COLUMNS)}, stamp, PRIMARY KEY (directory))")
        database.execute(f"PRAGMA user_version = {_VERSION}")
    database.execute("COMMIT")


def _is_current(database: sqlite3.Connection) -> bool:
    return bool(database.execute("PRAGMA user_version").fetchone()[0] == _VERSION)


def folder_stamp(folder: Path) -> str:
    """Return a text that changes whenever a run's record or summary is written."""
    parts = []
    for name in (RECORD, SUMMARY):
        with suppress(FileNotFoundError):
            status = os.stat(folder / name)  # noqa: PTH116 - twice as fast as Path.stat over many runs
            parts.append(f"{status.st_mtime_ns}:{status.st_size}:{status.st_ino}")
    return " ".join(parts)


def _row(folder: Path) -> RunRow:
    record, summary = RunRecord.read(folder), read_summary(folder)
    values: dict[str, Any] = {
        **dict.fromkeys(_COLUMNS),
        **summary,
        **vars(record),
        **vars(record.session),
        "cell": record.cell,
        "iterations": record.durable_iteration,
        "env_steps": record.durable_env_steps,
        "directory": str(folder),
    }
    return RunRow(**{name: values[name] for name in _COLUMNS})

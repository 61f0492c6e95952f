"""Store interface of the session process: cells and runs, sent to an MLflow server if there is one."""

import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from headway.config.experiment import StoreConfig
from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.atomic_files import locked, make_folder, write_json, write_text
from headway.store.energy_log import EnergyLog
from headway.store.fencing import close_gates, open_gate
from headway.store.parquet_log import read_rows
from headway.store.provenance import provenance
from headway.store.run_folder import (
    SUMMARY,
    Process,
    RunRecord,
    Status,
    cell_name,
    create_run_folder,
    find_run,
    now,
    read_rules,
    rules_file,
)
from headway.store.run_plan import PLAN
from headway.store.tracking.cells import CellSummary
from headway.store.tracking.thread import TrackingThread


class RunTakenError(HeadwayError):
    """Another session trains a run, or has finished it, since this session was planned."""

    def __init__(self, message: str, directories: Sequence[Path]) -> None:
        super().__init__(message)
        self.directories = tuple(directories)
        """Folders of the runs."""


EPISODES_RESTARTED = "episodes_restarted"
"""Tag with the iterations after which a run was resumed without snapshots of its environment."""
_LOCK_SECONDS = 30.0
_CLOSE_SECONDS = 120.0


class SessionStore:
    """Writer of the store for one session.

    Run folders are written immediately and durably. With `store.tracking_uri`, a thread sends copies to that
    MLflow, and its failures become notices and never end a run. The store's own MLflow database is made from
    the run folders by `headway browse` and `headway sync`: no session needs it.
    """

    def __init__(self, config: StoreConfig) -> None:
        """Raise HeadwayError if the root cannot be written or a given tracking URI does not respond."""
        self.root = Path(config.root).resolve()
        self.curve_points = config.curve_points
        make_folder(self.root)
        self.tracking_uri = config.tracking_uri
        self._mlflow = TrackingThread(self.root, uri) if (uri := config.tracking_uri) else None

    def claiming(self) -> AbstractContextManager[None]:
        """Return a lock under which one session at a time looks for runs of others and begins its own."""
        return locked(self.root / ".resume.lock", _LOCK_SECONDS, "runs were begun")

    def resume(self, run_ids: Sequence[str]) -> "list[Run]":
        """Reopen the killed or failed runs of one stack; their former training process can no longer write.

        Some of them, not all, may have finished: they keep their end and summary. Raises HeadwayError if
        there is no such run, and RunTakenError if another session runs one or all have finished.
        """
        directories = [find_run(self.root, run_id) for run_id in run_ids]
        with self.claiming():
            records = [RunRecord.read(directory) for directory in directories]
            try:
                for record in records:
                    record.require_free()
            except HeadwayError as error:
                raise RunTakenError(str(error), directories) from error
            if all(record.status == "FINISHED" for record in records):
                message = f"run {records[0].run_id} has finished: there is nothing to resume"
                raise RunTakenError(message, directories)
            return [self._reopen(*run) for run in zip(directories, records, strict=True)]

    def _reopen(self, directory: Path, record: RunRecord) -> "Run":
        if record.status == "FINISHED":
            return Run(self, directory, record, open_gate(directory))
        record = replace(
            record,
            status="RUNNING",
            ended=None,
            session=Process.current(),
            tracking_uri=self.tracking_uri,
            curve_points=self.curve_points,
        )
        gate = open_gate(directory)
        record.write(directory)
        return Run(self, directory, record, gate)

    def notices(self) -> tuple[str, ...]:
        """Return the lines for the user since the last call."""
        return self._mlflow.notices() if self._mlflow else ()

    def follow(self, directory: Path) -> None:
        """Send a run to the MLflow server in the background, if there is one."""
        if self._mlflow:
            self._mlflow.follow(directory)

    def close(self, seconds: float = _CLOSE_SECONDS) -> tuple[str, ...]:
        """Wait, at most `seconds`, until the MLflow server is up to date; return the last notices.

        Runs of earlier sessions are included.
        """
        if self._mlflow:
            self._mlflow.close(seconds)
        return self.notices()


class Cell:
    """All seeds of one environment, algorithm and parameters in a study."""

    def __init__(
        self,
        store: SessionStore,
        study: str,
        environment: str,
        algorithm: str,
        parameters: Mapping[str, object],
    ) -> None:
        """`parameters` (flat, dotted names) are the same for all seeds."""
        self._store, self._tags = store, provenance()
        self._study, self._environment, self._algorithm = study, environment, algorithm
        self._parameters = {name: str(value) for name, value in parameters.items()}
        self.name = cell_name(environment, algorithm, self._parameters)

    def begin_run(
        self,
        seed: int,
        config_yaml: str,
        plan: Mapping[str, Any],
        *,
        iterations: int,
        policies: str = "",
        preset: str = "",
        candidate: str = "",
    ) -> "Run":
        """Create a run with a budget of `iterations`.

        Its folder is complete on return, ready for a training process. Raises HeadwayError if it cannot be
        written.
        """
        run_id, directory = create_run_folder(self._store.root, self._study, self.name, seed)
        record = RunRecord(
            run_id=run_id,
            study=self._study,
            environment=self._environment,
            algorithm=self._algorithm,
            seed=seed,
            iterations=iterations,
            started=now(),
            session=Process.current(),
            policies=policies,
            preset=preset,
            candidate=candidate,
            parameters=self._parameters,
            tags=self._tags,
            tracking_uri=self._store.tracking_uri,
            curve_points=self._store.curve_points,
        )
        write_text(directory / "config.yaml", config_yaml)
        write_json(directory / PLAN, plan)
        record.write(directory)
        return Run(self._store, directory, record, open_gate(directory))

    def keep_rules(self, episodes: Mapping[str, Sequence[Row]]) -> None:
        """Store the evaluation episodes of classical rules for the cell: rule name -> one row per episode.

        Rules stored by earlier sessions stay, unless `episodes` replaces them or their file is damaged.
        """
        if not episodes:
            return
        path = rules_file(self._store.root, self._study, self.name)
        stored: dict[str, Any] = {}
        with suppress(HeadwayError):
            stored = read_rules(self._store.root, self._study, self.name)
        write_json(path, stored | {rule: [dict(row) for row in rows] for rule, rows in episodes.items()})

    def finish(self, status: Status, metrics: Mapping[str, float] | None = None) -> None:
        """Store rule returns, session energy and status of the cell, which MLflow gets with its runs.

        Metrics of earlier sessions stay, unless `metrics` replaces them. Raises HeadwayError if the summary
        cannot be written.
        """
        CellSummary(
            study=self._study,
            cell=self.name,
            parameters=self._parameters,
            session=Process.current(),
            tracking_uri=self._store.tracking_uri,
            status=status,
            ended=now(),
            metrics=metrics or {},
        ).keep(self._store.root)


class Run:
    """One seed's run as the session records it.

    The training process writes the log and the checkpoints in `directory`, through `gate`.
    """

    def __init__(self, store: SessionStore, directory: Path, record: RunRecord, gate: Path) -> None:
        self.directory, self.gate = directory, gate
        self.record = record
        self._counted_at = time.monotonic()
        """Time up to which the record's duration counts, on this session's clock."""
        self.energy = EnergyLog(directory)
        """Energy samples of the run, whose values are totals over all sessions."""
        store.follow(directory)

    @property
    def run_id(self) -> str:
        """Identity of the run in the store."""
        return self.record.run_id

    @property
    def duration_s(self) -> float:
        """Wall time so far over all sessions, s, while the run is trained."""
        return self.record.duration_s + time.monotonic() - self._counted_at

    def durable(self, iteration: int) -> None:
        """Record that the training process has made everything up to `iteration` durable.

        Raises HeadwayError if the record cannot be written or the log cannot be read.
        """
        # Fewer iterations than recorded, if training has resumed from an older checkpoint.
        before = min(self.record.durable_iteration, iteration - 1)
        logged = read_rows(self.directory, "curve", after=before)
        env_steps = [int(row["env_steps"]) for row in logged if int(row["iteration"]) <= iteration]
        self.record = replace(
            self.record,
            durable_iteration=iteration,
            durable_env_steps=max(env_steps, default=self.record.durable_env_steps),
        )
        if self.record.status == "RUNNING":  # else an earlier session has finished it
            # A session that is killed records nothing at its end.
            self.record = replace(self.record, duration_s=self.duration_s)
            self._counted_at = time.monotonic()
        self.record.write(self.directory)
        self.energy.write_if_due()

    def note_restart(self, iteration: int) -> None:
        """Tag the run as resumed without snapshots, with new episodes after `iteration`.

        Its curves differ from those of an uninterrupted run. Raises HeadwayError if the record cannot be
        written.
        """
        before = self.record.tags.get(EPISODES_RESTARTED)
        after = f"{before}, {iteration}" if before else str(iteration)
        self.record = replace(self.record, tags={**self.record.tags, EPISODES_RESTARTED: after})
        self.record.write(self.directory)

    def finish(self, status: Status, summary: Mapping[str, float | int | str | None]) -> None:
        """End the run after its training process: close its gate, then write summary and status.

        `summary`: `final_reward`, `auc`, `kwh`, `kg_co2`, ...; None: unknown. A run that an earlier session
        finished keeps its summary: MLflow may have it already and can only append. Raises HeadwayError if the
        files cannot be written or the log cannot be read.
        """
        close_gates(self.directory)
        if self.record.status == "FINISHED":
            return
        self.energy.write()
        write_json(self.directory / SUMMARY, summary)
        self.record = replace(self.record, status=status, ended=now(), duration_s=self.duration_s)
        self.record.write(self.directory)

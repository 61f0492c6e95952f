"""What the session process uses: cells, runs, and MLflow following behind in a thread of its own."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Self

from headway.config.experiment import StoreConfig
from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.artifacts import write_views
from headway.store.atomic_files import locked, make_folder, read_json, write_json, write_text
from headway.store.energy_log import EnergyLog
from headway.store.fencing import open_gate, shut_gates
from headway.store.index import RunIndex
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
    rules_file,
)
from headway.store.tracking.client import Tracker
from headway.store.tracking.sync import RunFollower, behind, deliver
from headway.store.tracking.thread import TrackingTask, TrackingThread

EPISODES_RESTARTED = "episodes_restarted"
"""Tag of a run that was resumed where its environment keeps no snapshots: after which iterations."""
_LOCK_SECONDS = 30.0
_CLOSE_SECONDS = 120.0


class SessionStore:
    """The store as one session writes it. Run folders are written at once and durably; MLflow follows in
    a thread, and where it fails that is a notice, never the end of a run."""

    def __init__(self, config: StoreConfig) -> None:
        self.root = Path(config.root).resolve()
        self.curve_points = config.curve_points
        make_folder(self.root)
        self.tracking_uri = config.tracking_uri
        self._mlflow = TrackingThread(self.root, config.tracking_uri)

    @classmethod
    def open(cls, config: StoreConfig) -> Self:
        """Open (or create) the store. Raises HeadwayError if its root cannot be written, or a tracking URI
        is given that does not answer."""
        store = cls(config)
        if config.tracking_uri is not None:
            store._mlflow.connect()
        return store

    def begin_cell(
        self,
        study: str,
        environment: str,
        algorithm: str,
        parameters: Mapping[str, object],
        tags: Mapping[str, str] | None = None,
    ) -> "Cell":
        """A cell of a study. `parameters` (flat, dotted names) are the same for all its seeds; `tags` go
        to each run, beside what `provenance` finds."""
        texts = {name: str(value) for name, value in parameters.items()}
        return Cell(self, study, environment, algorithm, texts, {**provenance(), **(tags or {})})

    def resume(self, run_id: str, of_a_stack: bool = False) -> "Run":
        """Take up a run that was killed or failed. Raises HeadwayError if there is none, it has finished
        (and is not of a stack, whose other seeds may not have), or another session runs it. A training
        process of before that still lives somewhere can write to it no more."""
        directory = find_run(self.root, run_id)
        with locked(self.root / ".resume.lock", _LOCK_SECONDS, "a run was resumed"):
            record = RunRecord.read(directory)
            record.require_free()
            if record.status == "FINISHED" and not of_a_stack:
                raise HeadwayError(f"run {record.run_id} has finished: there is nothing to resume")
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

    @property
    def index(self) -> RunIndex:
        """The summaries of all runs of this store."""
        return RunIndex(self.root)

    def notices(self) -> tuple[str, ...]:
        """Lines for the user since the last call."""
        return self._mlflow.notices()

    def follow(self, errand: TrackingTask) -> None:
        """Let the MLflow thread do it, after all given to it before."""
        self._mlflow.submit(errand)

    def close(self, seconds: float = _CLOSE_SECONDS) -> tuple[str, ...]:
        """Wait (at most so long) until MLflow is up to date, also with what earlier sessions left; returns
        the last notices."""
        if behind(self.root, self.tracking_uri):
            self.follow(TrackingTask(self._deliver, lambda: None, self._deliver))
        self._mlflow.close(seconds)
        return self.notices()

    def _deliver(self, tracker: Tracker) -> None:
        deliver(self.root, tracker)


class Cell:
    """All seeds of one environment, algorithm and parameters in a study."""

    def __init__(
        self,
        store: SessionStore,
        study: str,
        environment: str,
        algorithm: str,
        parameters: Mapping[str, str],
        tags: Mapping[str, str],
    ) -> None:
        self._store = store
        self._study, self._environment, self._algorithm = study, environment, algorithm
        self._parameters, self._tags = parameters, tags
        self.name = cell_name(environment, algorithm, parameters)

    def begin_run(
        self,
        seed: int,
        config_yaml: str,
        plan: Mapping[str, Any],
        tags: Mapping[str, str] | None = None,
        *,
        iterations: int,
        policies: str = "",
        preset: str = "",
        candidate: str = "",
    ) -> "Run":
        """A new run of a budget of `iterations`; its folder is complete when this returns, so a training
        process may start. Raises HeadwayError if it cannot be written."""
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
            tags={**self._tags, **(tags or {})},
            tracking_uri=self._store.tracking_uri,
            curve_points=self._store.curve_points,
        )
        write_text(directory / "config.yaml", config_yaml)
        write_json(directory / "plan.json", plan)
        record.write(directory)
        return Run(self._store, directory, record, open_gate(directory))

    def keep_rules(self, episodes: Mapping[str, Sequence[Row]]) -> None:
        """Keep what rules did on the evaluation days, beside the cell's runs: name -> one row a day. Rules
        kept by earlier sessions stay, but for those played again."""
        if not episodes:
            return
        path = rules_file(self._store.root, self._study, self.name)
        kept = read_json(path) if path.exists() else {}
        write_json(path, kept | {rule: [dict(row) for row in rows] for rule, rows in episodes.items()})

    def finish(self, status: Status, figures: Mapping[str, float] | None = None) -> None:
        """End the cell's parent run in MLflow, with figures over its seeds."""
        ended, sent = now(), dict(figures or {})

        def end(tracker: Tracker) -> None:
            _, parent = tracker.cell(self._study, self.name, self._parameters, {}, going_on=False)
            tracker.finish(parent, status, ended, sent, ())

        self._store.follow(TrackingTask(end, lambda: None, end))


class Run:
    """One seed, as the session writes it; its training process writes the log in `directory` itself, through
    `gate`."""

    def __init__(self, store: SessionStore, directory: Path, record: RunRecord, gate: Path) -> None:
        self.directory, self.gate = directory, gate
        self.record = record
        self._store = store
        self._resumed_at = now()
        self._rows: list[Row] = []
        self._energy = EnergyLog(directory)
        self._follower = RunFollower(directory, store.curve_points)
        self._tell(self._follower.begin)

    @property
    def run_id(self) -> str:
        """Its identity in the store."""
        return self.record.run_id

    def points(self, rows: Iterable[Row]) -> None:
        """Take rows of the curve; they go to MLflow, thinned, once they are durable."""
        self._rows.extend(rows)

    def durable(self, iteration: int) -> None:
        """The training process has made everything up to `iteration` durable. Raises HeadwayError if the
        record of that cannot be written."""
        ready = [row for row in self._rows if int(row.get("iteration", 0)) <= iteration]
        self._rows = [row for row in self._rows if int(row.get("iteration", 0)) > iteration]
        heard = ready
        if iteration and all(int(row.get("iteration", 0)) < iteration for row in ready):
            # An earlier session was killed between the checkpoint and hearing of it: the log has the rows.
            logged = read_rows(self.directory, "curve")
            heard = [row for row in logged if int(row.get("iteration", 0)) <= iteration]
        env_steps = [int(row["env_steps"]) for row in heard if "env_steps" in row]
        self.record = replace(
            self.record,
            durable_iteration=iteration,
            durable_env_steps=max([self.record.durable_env_steps, *env_steps]),
        )
        self.record.write(self.directory)
        self._energy.write_if_due()
        self._tell(lambda tracker: self._follower.advance(tracker, ready, iteration))

    def note_restart(self, iteration: int) -> None:
        """Tag the run: its episodes were begun anew after `iteration`, so that its curves are not those of a
        run never stopped. Raises HeadwayError if the record of that cannot be written."""
        before = self.record.tags.get(EPISODES_RESTARTED)
        after = f"{before}, {iteration}" if before else str(iteration)
        self.record = replace(self.record, tags={**self.record.tags, EPISODES_RESTARTED: after})
        self.record.write(self.directory)
        self._tell(lambda tracker: self._follower.tag(tracker, EPISODES_RESTARTED, after))

    def energy(self, sample: Row) -> None:
        """Take one energy sample of this run (a row of `energy.parquet`): its energy so far, that of
        earlier sessions included (see `energy_so_far`)."""
        self._energy.append(sample)

    @property
    def energy_so_far(self) -> Row:
        """The last energy sample, of an earlier session if this one has given none; empty if none has."""
        return self._energy.last()

    def finish(self, status: Status, summary: Mapping[str, float | int | str | None]) -> None:
        """End the run, which nobody trains any more, with its summary figures (`final_reward`, `auc`, `kwh`,
        `kg_co2`, ...; None where not known) and what of it can be looked at. Raises HeadwayError if they
        cannot be written, or its log cannot be read."""
        shut_gates(self.directory)
        self._energy.write()
        write_json(self.directory / SUMMARY, summary)
        write_views(self.directory, self.run_id)
        ended = self.record.ended_as(status)
        self.record = replace(ended, duration_s=ended.duration_s + _seconds_since(self._resumed_at))
        self.record.write(self.directory)
        self._tell(self._follower.complete)

    def _tell(self, step: Callable[[Tracker], object]) -> None:
        self._store.follow(TrackingTask(step, self._follower.forget, self._follower.catch_up))


def _seconds_since(moment: str) -> float:
    return (datetime.fromisoformat(now()) - datetime.fromisoformat(moment)).total_seconds()

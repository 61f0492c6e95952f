"""Plans of sweeps, stored before training begins, and their progress in the store."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import make_folder, read_json, write_json
from headway.store.cell_names import CellChoice, names_among
from headway.store.run_configuration import upgraded
from headway.store.run_folder import cell_name, plans_folder
from headway_launch.experiments.compose import resolve
from headway_launch.experiments.experiment import Experiment, PreparedEnv
from headway_launch.experiments.parameters import cell_parameters, full_mapping, identity
from headway_launch.runner.jobs import CellPlan, PlannedJob, new_jobs
from headway_launch.runner.stored_run import StoredRun, jobs_to_resume

if TYPE_CHECKING:
    from headway.store.index import RunRow


@dataclass(frozen=True)
class StudyProgress:
    """Progress of one experiment in the store, seed by seed."""

    experiment: Experiment
    finished: tuple[StoredRun, ...] = ()
    """Newest finished run of each seed that has one."""
    unfinished: tuple[StoredRun, ...] = ()
    """For each seed without a finished run: its run with the most iterations, if it was killed or failed."""
    elsewhere: tuple[StoredRun, ...] = ()
    """For each seed without a finished run: a run that another session is training."""
    new: tuple[int, ...] = ()
    """Seeds without a run."""
    run_ids: frozenset[str] | None = None
    """Identities of all runs of these seeds; None if stored runs are ignored."""

    @classmethod
    def of(cls, root: Path, experiment: Experiment, rows: Sequence["RunRow"]) -> "StudyProgress":
        """Return the progress of an experiment; `rows`: index rows of its study's runs."""
        parameters = {name: str(value) for name, value in cell_parameters(experiment).items()}
        cell = cell_name(experiment.config.env.id, experiment.algo_name, parameters)
        wanted = identity(full_mapping(experiment, ()))
        by_seed: dict[int, list[tuple[RunRow, StoredRun]]] = {seed: [] for seed in experiment.config.seed}
        for row in rows:
            if row.cell == cell and row.seed in by_seed:
                run = StoredRun.read(root, Path(row.directory))
                if run.identity == wanted:
                    by_seed[row.seed].append((row, run))
        by_kind: dict[str, list[StoredRun]] = {"finished": [], "unfinished": [], "elsewhere": []}
        new = []
        for seed, found in by_seed.items():
            if not found:
                new.append(seed)
                continue
            row, run = max(found, key=lambda one: (_RANKS[one[0].status], one[0].iterations, one[0].started))
            by_kind[_KINDS[row.status]].append(run)
        _keep_stacks_whole(by_kind["finished"], by_kind["unfinished"], new)
        new.sort(key=list(by_seed).index)
        return cls(
            experiment,
            finished=tuple(by_kind["finished"]),
            unfinished=tuple(by_kind["unfinished"]),
            elsewhere=tuple(by_kind["elsewhere"]),
            new=tuple(new),
            run_ids=frozenset(row.run_id for found in by_seed.values() for row, _ in found),
        )

    @classmethod
    def untouched(cls, experiment: Experiment) -> "StudyProgress":
        """Return the progress of an experiment without stored runs."""
        return cls(experiment, new=experiment.config.seed)

    def plan(self, known: dict[str, PreparedEnv], label: str = "") -> CellPlan:
        """Return the remaining work.

        Raises HeadwayError if a job cannot run. `known`: environments prepared before, as in
        `Experiment.prepare`.
        """
        jobs: list[PlannedJob] = []
        self._require_whole_stacks()
        for batch in jobs_to_resume(
            [_with_session_settings(run, self.experiment) for run in self.unfinished], known
        ):
            jobs += batch
        if self.new:
            jobs += new_jobs(self.experiment, self.new, known)
        finished = tuple(run.directory for run in self.finished)
        elsewhere = tuple(run.directory for run in self.elsewhere)
        return CellPlan(self.experiment, tuple(jobs), finished, label, self.run_ids, elsewhere)

    def _require_whole_stacks(self) -> None:
        there = {run.record.seed for run in self.unfinished}
        for run in self.unfinished:
            if not there.issuperset(run.plan.stack):
                seeds = ",".join(map(str, run.plan.stack))
                raise HeadwayError(
                    f"seeds {seeds} were trained in one stack and resume together only: sweep seed={seeds}, "
                    f"or headway resume --study {shlex.quote(self.experiment.config.study)}"
                )


def _keep_stacks_whole(finished: list[StoredRun], unfinished: list[StoredRun], new: list[int]) -> None:
    """Move runs between the lists so that all seeds of a stack resume together or all begin again."""
    for stack in {run.plan.stack for run in unfinished}:
        # A session killed while it started a stack leaves seeds without a run: train all of it again.
        if not set(stack).isdisjoint(new):
            new += [run.record.seed for run in unfinished if run.plan.stack == stack]
            unfinished[:] = [run for run in unfinished if run.plan.stack != stack]
            continue
        # A session killed while it ended a stack leaves some of its seeds finished: resume these too.
        ended = [run for run in finished if run.record.seed in stack and run.plan.stack == stack]
        unfinished += ended
        finished[:] = [run for run in finished if run not in ended]


_RANKS = {"FAILED": 0, "KILLED": 0, "RUNNING": 1, "FINISHED": 2}
_KINDS = {"FAILED": "unfinished", "KILLED": "unfinished", "RUNNING": "elsewhere", "FINISHED": "finished"}


def plan_cells(progress: Sequence[StudyProgress], labels: Sequence[str] | None = None) -> list[CellPlan]:
    """Return the remaining work of each experiment. `labels`: names of the cells; None: `cell_labels`.

    Raises HeadwayError if a job cannot run.
    """
    known: dict[str, PreparedEnv] = {}
    if labels is None:
        labels = cell_labels([each.experiment for each in progress])
    return [each.plan(known, label) for each, label in zip(progress, labels, strict=True)]


def cell_labels(experiments: Sequence[Experiment]) -> list[str]:
    """Return the labels of the cells of one session, as the store names them; empty for a single cell."""
    if len(experiments) < 2:
        return [""] * len(experiments)
    cells = {
        str(place): CellChoice(
            experiment.config.env.id,
            experiment.algo_name,
            experiment.config.preset,
            {name: str(value) for name, value in cell_parameters(experiment).items()},
            experiment.config.candidate,
        )
        for place, experiment in enumerate(experiments)
    }
    names = names_among(cells)
    return [names[place].label for place in cells]


def distinct(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Merge experiments of equal `identity` and combine their seeds; other settings are the last one's."""
    merged: dict[str, Experiment] = {}
    for experiment in experiments:
        key = identity(full_mapping(experiment, ()))
        if key in merged:
            seeds = dict.fromkeys((*merged[key].config.seed, *experiment.config.seed))
            experiment = replace(experiment, config=replace(experiment.config, seed=tuple(seeds)))
        merged[key] = experiment
    return list(merged.values())


def keep_plan(root: Path, study: str, experiments: Sequence[Experiment]) -> None:
    """Store the plan of a sweep durably, so that `headway resume --study` can find the runs not started.

    The same plan overwrites its file. Raises HeadwayError if it cannot be written.
    """
    cells = [
        {"config": full_mapping(experiment, ()), "seeds": list(experiment.config.seed)}
        for experiment in experiments
    ]
    digest = sha256(json.dumps(cells, sort_keys=True, default=str).encode()).hexdigest()[:12]
    folder = plans_folder(root, study)
    make_folder(folder)
    write_json(folder / f"{digest}.json", {"cells": cells})


def kept_plans(root: Path, study: str) -> list[Experiment]:
    """Return the experiments in the stored plans of a study, merged by `distinct`, oldest plan first.

    Raises HeadwayError for a plan that cannot be read or that this version refuses.
    """
    experiments = []
    for path in sorted(plans_folder(root, study).glob("*.json"), key=lambda path: path.stat().st_mtime_ns):
        for cell in _cells(path):
            if cell["config"].get("study") != study:  # its name differs in characters that folders lack
                continue
            mapping = {**upgraded(cell["config"]), "seed": cell["seeds"]}
            # The store may have been moved since the plan was written.
            mapping["store"] = {**mapping.get("store", {}), "root": str(root)}
            experiments.append(resolve(mapping))
    return distinct(experiments)


def _cells(path: Path) -> list[Mapping[str, Any]]:
    cells = read_json(path).get("cells")
    if not isinstance(cells, list) or not all(
        isinstance(cell, dict) and {"config", "seeds"} <= set(cell) for cell in cells
    ):
        raise HeadwayError(f"{path} is not the plan of a sweep; remove or repair it")
    return cells


def _with_session_settings(run: StoredRun, experiment: Experiment) -> StoredRun:
    """Return a stored run with the store, energy and parallelism settings of this session.

    The run keeps its backend, to which its checkpoints belong, unless both backends are `process` or `ray`,
    which can resume each other's checkpoints.
    """
    mapping = full_mapping(experiment, ())
    requested, stored = mapping["backend"], run.mapping["backend"]
    interchangeable = {requested["name"], stored["name"]} <= {"process", "ray"}
    taken = ["parallel", "worker_timeout_s"]
    taken += ["name", "address", "worker_cpus", "learners"] if interchangeable else []
    backend = {**stored, **{key: requested[key] for key in taken}}
    session = {"store": mapping["store"], "energy": mapping["energy"], "backend": backend}
    return replace(run, mapping={**run.mapping, **session})

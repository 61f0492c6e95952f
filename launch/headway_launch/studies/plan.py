"""What a sweep set out to do, kept before it begins, and what the store has of it already."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import make_folder, read_json, write_json
from headway.store.cell_names import CellChoice, names_among
from headway.store.run_folder import cell_name, plans_folder
from headway_launch.experiments.compose import Experiment, PreparedEnv, resolve
from headway_launch.experiments.parameters import cell_parameters, full_mapping, identity
from headway_launch.runner.jobs import CellPlan, PlannedJob, new_jobs
from headway_launch.runner.stored_run import StoredRun, jobs_to_resume

if TYPE_CHECKING:
    from headway.store.index import RunRow


@dataclass(frozen=True)
class StudyProgress:
    """What the store has of the seeds of one experiment."""

    experiment: Experiment
    finished: tuple[StoredRun, ...] = ()
    """The newest finished run of each seed that has one."""
    unfinished: tuple[StoredRun, ...] = ()
    """Of each other seed the run that came farthest, if it was killed or failed."""
    elsewhere: tuple[StoredRun, ...] = ()
    """Of each other seed a run that another session trains now."""
    new: tuple[int, ...] = ()
    """Seeds that have no run."""
    run_ids: frozenset[str] = frozenset()
    """All runs of these seeds, older ones too."""

    @classmethod
    def of(cls, root: Path, experiment: Experiment, rows: Sequence["RunRow"]) -> "StudyProgress":
        """The standing of an experiment among the runs of its study."""
        parameters = {name: str(value) for name, value in cell_parameters(experiment).items()}
        cell = cell_name(experiment.config.env.id, experiment.algo_name, parameters)
        wanted = identity(full_mapping(experiment, ()))
        by_seed: dict[int, list[tuple[RunRow, StoredRun]]] = {seed: [] for seed in experiment.config.seed}
        for row in rows:
            if row.cell == cell and row.seed in by_seed:
                run = StoredRun.read(root, Path(row.directory))
                if run.identity == wanted:
                    by_seed[row.seed].append((row, run))
        standing: dict[str, list[StoredRun]] = {"finished": [], "unfinished": [], "elsewhere": []}
        new = []
        for seed, found in by_seed.items():
            if not found:
                new.append(seed)
                continue
            row, run = max(found, key=lambda one: (_RANKS[one[0].status], one[0].iterations, one[0].started))
            standing[_KINDS[row.status]].append(run)
        _keep_stacks_whole(standing["finished"], standing["unfinished"], new)
        new.sort(key=list(by_seed).index)
        return cls(
            experiment,
            finished=tuple(standing["finished"]),
            unfinished=tuple(standing["unfinished"]),
            elsewhere=tuple(standing["elsewhere"]),
            new=tuple(new),
            run_ids=frozenset(row.run_id for found in by_seed.values() for row, _ in found),
        )

    @classmethod
    def untouched(cls, experiment: Experiment) -> "StudyProgress":
        """As if the store had nothing of it."""
        return cls(experiment, new=experiment.config.seed)

    def plan(self, known: dict[str, PreparedEnv], label: str = "") -> CellPlan:
        """What is left to do for it. Raises HeadwayError for what cannot run."""
        jobs: list[PlannedJob] = []
        self._require_whole_stacks()
        for batch in jobs_to_resume([_in_session(run, self.experiment) for run in self.unfinished], known):
            jobs += batch
        if self.new:
            jobs += new_jobs(self.experiment, self.new, known)
        return CellPlan(self.experiment, tuple(jobs), tuple(run.directory for run in self.finished), label)

    def _require_whole_stacks(self) -> None:
        there = {run.record.seed for run in self.unfinished}
        for run in self.unfinished:
            if not there.issuperset(run.stack):
                seeds = ",".join(map(str, run.stack))
                raise HeadwayError(
                    f"seeds {seeds} were trained in one stack and go on together: sweep seed={seeds}, "
                    f"or headway resume --study {self.experiment.config.study}"
                )


def _keep_stacks_whole(finished: list[StoredRun], unfinished: list[StoredRun], new: list[int]) -> None:
    """Seeds of a stack go on together. A session that was killed while it ended them one after another has
    left finished ones among them, and they go on too, for nothing but their end; one that was killed while it
    began them has left seeds without a run, and all begin anew."""
    for stack in {run.stack for run in unfinished}:
        if not set(stack).isdisjoint(new):
            new += [run.record.seed for run in unfinished if run.stack == stack]
            unfinished[:] = [run for run in unfinished if run.stack != stack]
            continue
        ended = [run for run in finished if run.record.seed in stack and run.stack == stack]
        unfinished += ended
        finished[:] = [run for run in finished if run not in ended]


_RANKS = {"FAILED": 0, "KILLED": 0, "RUNNING": 1, "FINISHED": 2}
_KINDS = {"FAILED": "unfinished", "KILLED": "unfinished", "RUNNING": "elsewhere", "FINISHED": "finished"}


def plan_cells(standings: Sequence[StudyProgress], labels: Sequence[str] | None = None) -> list[CellPlan]:
    """What is left to do for each; `labels`: what they are called, by default after what they differ in.

    Raises HeadwayError for what cannot run.
    """
    known: dict[str, PreparedEnv] = {}
    if labels is None:
        labels = cell_labels([standing.experiment for standing in standings])
    return [standing.plan(known, label) for standing, label in zip(standings, labels, strict=True)]


def cell_labels(experiments: Sequence[Experiment]) -> list[str]:
    """What cells of one session are called, as where the store names them. A single one needs no name."""
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
    """Each experiment once: those that train the same but for their seeds are one, kept and measured as the
    last of them says."""
    merged: dict[str, Experiment] = {}
    for experiment in experiments:
        key = identity(full_mapping(experiment, ()))
        if key in merged:
            seeds = dict.fromkeys((*merged[key].config.seed, *experiment.config.seed))
            experiment = replace(experiment, config=replace(experiment.config, seed=tuple(seeds)))
        merged[key] = experiment
    return list(merged.values())


def keep_plan(root: Path, study: str, experiments: Sequence[Experiment]) -> None:
    """Write down, durably, what a sweep sets out to do, so that `headway resume --study` knows the runs that
    had not begun. The same sweep has the same file. Raises HeadwayError if that fails."""
    cells = [
        {"config": full_mapping(experiment, ()), "seeds": list(experiment.config.seed)}
        for experiment in experiments
    ]
    digest = sha256(json.dumps(cells, sort_keys=True, default=str).encode()).hexdigest()[:12]
    folder = plans_folder(root, study)
    make_folder(folder)
    write_json(folder / f"{digest}.json", {"cells": cells})


def kept_plans(root: Path, study: str) -> list[Experiment]:
    """The experiments that sweeps of a study set out to do, each once, as the newest says.

    Raises HeadwayError for a file that cannot be read, or that this version refuses.
    """
    experiments = []
    for path in sorted(plans_folder(root, study).glob("*.json"), key=lambda path: path.stat().st_mtime_ns):
        for cell in _cells(path):
            mapping = {**cell["config"], "seed": cell["seeds"]}
            # The store may have been moved since.
            mapping["store"] = {**mapping.get("store", {}), "root": str(root)}
            experiments.append(resolve(mapping))
    return distinct(experiments)


def _cells(path: Path) -> list[Mapping[str, Any]]:
    cells = read_json(path).get("cells")
    if not isinstance(cells, list) or not all(
        isinstance(cell, dict) and {"config", "seeds"} <= set(cell) for cell in cells
    ):
        raise HeadwayError(f"{path} is no plan of a sweep: remove it, or repair it")
    return cells


def _in_session(run: StoredRun, experiment: Experiment) -> StoredRun:
    """A stored run as this session goes on with it: kept, measured and put side by side as the session says,
    but by a backend that its checkpoints are of: where processes stopped actors can go on, and the other way
    round, and a cluster is where the session has it."""
    mapping = full_mapping(experiment, ())
    asked, kept = mapping["backend"], run.mapping["backend"]
    alike = {asked["name"], kept["name"]} <= {"process", "ray"}
    taken = ("parallel", "name", "address", "worker_cpus", "learners") if alike else ("parallel",)
    backend = {**kept, **{key: asked[key] for key in taken}}
    session = {"store": mapping["store"], "energy": mapping["energy"], "backend": backend}
    return replace(run, mapping={**run.mapping, **session})

"""Runs in the store, as experiments again."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import read_json
from headway.store.run_folder import RunRecord, find_run
from headway_launch.experiments.compose import Experiment, PreparedEnv, resolve
from headway_launch.experiments.parameters import identity
from headway_launch.runner.jobs import PlannedJob


@dataclass(frozen=True)
class StoredRun:
    """One run folder: what it is, how it was configured, which seeds were trained in its stack."""

    directory: Path
    record: RunRecord
    mapping: dict[str, Any]
    stack: tuple[int, ...]
    workers: int | None
    """Rollout workers, each with its part of a checkpoint; None where the run's plan does not tell."""
    block: int | None = None
    """Copies whose actions are computed in one piece, which may be fewer than were asked for; None where the
    run's plan does not tell."""

    @classmethod
    def find(cls, root: Path, run_id: str) -> "StoredRun":
        """The run of that identity, or a part of it that only one has.

        Raises HeadwayError if there is none or its folder is incomplete.
        """
        return cls.read(root, find_run(root, run_id))

    @classmethod
    def read(cls, root: Path, directory: Path) -> "StoredRun":
        """The run in a folder. Raises HeadwayError if that is incomplete."""
        mapping = read_configuration(directory)
        # The store may have been moved since.
        mapping["store"] = {**mapping.get("store", {}), "root": str(root)}
        plan = read_json(directory / "plan.json")
        stack = tuple(int(seed) for seed in plan["stack"])
        block = plan.get("rollout", {}).get("block")
        return cls(directory, RunRecord.read(directory), mapping, stack, plan.get("workers"), block)

    @property
    def configuration(self) -> str:
        """Its whole configuration but for the seed, to be compared."""
        rest = {key: value for key, value in self.mapping.items() if key != "seed"}
        return json.dumps(rest, sort_keys=True, default=str)

    @property
    def identity(self) -> str:
        """See `identity`."""
        return identity(self.mapping)

    @property
    def experiment(self) -> Experiment:
        """Its configuration, validated anew. Raises HeadwayError if this version refuses it."""
        return resolve(self.mapping)


def read_configuration(directory: Path) -> dict[str, Any]:
    """The configuration in a run's folder. Raises HeadwayError if it cannot be read."""
    import yaml

    path = directory / "config.yaml"
    # The loader in C is ten times faster, which shows where a study has hundreds of runs.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        mapping = yaml.load(path.read_text(encoding="utf-8"), loader)
    except (OSError, yaml.YAMLError) as error:
        reason = str(error).splitlines()[0]
        raise HeadwayError(f"{path} cannot be read ({reason}): the run cannot be used") from error
    if not isinstance(mapping, dict):
        raise HeadwayError(f"{path} holds no configuration: the run cannot be used")
    return mapping


def jobs_to_resume(
    runs: Sequence[StoredRun], known: dict[str, PreparedEnv] | None = None
) -> list[tuple[PlannedJob, ...]]:
    """The jobs that go on with `runs`, stacks as they were: those of one configuration together, but for
    runs of one seed, which go on one after another. `known` as for `Experiment.prepare`.

    Raises HeadwayError where a stack is incomplete: its seeds go on together or not at all.
    """
    batches: dict[tuple[str, int], list[StoredRun]] = {}
    times: Counter[tuple[str, int]] = Counter()
    # By age, so that the runs of a stack, which began together, come into one batch.
    for run in sorted(runs, key=lambda run: run.record.started):
        seed = run.configuration, run.record.seed
        batches.setdefault((run.configuration, times[seed]), []).append(run)
        times[seed] += 1
    return [_batch_jobs(batch, known) for batch in batches.values()]


def _batch_jobs(runs: Sequence[StoredRun], known: dict[str, PreparedEnv] | None) -> tuple[PlannedJob, ...]:
    first = runs[0]
    seeds = [run.record.seed for run in runs]
    experiment = resolve({**first.mapping, "seed": seeds})
    found = experiment.prepare(known)
    by_seed = {run.record.seed: run for run in runs}
    stacks = list(dict.fromkeys(run.stack for run in runs))
    jobs = []
    for stack in stacks:
        missing = [seed for seed in stack if seed not in by_seed]
        if missing:
            raise HeadwayError(
                f"seeds {', '.join(map(str, stack))} were trained in one stack and go on together; "
                f"name the runs of seed {', '.join(map(str, missing))} too"
            )
        run_ids = tuple(by_seed[seed].record.run_id for seed in stack)
        iteration = min(by_seed[seed].record.durable_iteration for seed in stack)
        planned = by_seed[stack[0]]
        config = experiment.config
        if planned.block is not None:
            config = replace(config, rollout=replace(config.rollout, block=planned.block))
        jobs.append(
            PlannedJob(
                experiment,
                config,
                found.prepared,
                found.training,
                found.spec,
                stack,
                run_ids,
                iteration,
                planned.workers,
            )
        )
    return tuple(jobs)

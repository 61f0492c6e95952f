"""Runs read from the store and turned back into experiments and jobs."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from headway.contracts.errors import HeadwayError
from headway.store.checkpoint import latest_iteration
from headway.store.run_configuration import read_configuration
from headway.store.run_folder import CHECKPOINTS, RunRecord, find_run
from headway.store.run_plan import RunPlan
from headway_launch.experiments.compose import require_grammar, resolve
from headway_launch.experiments.experiment import Experiment, PreparedEnv
from headway_launch.experiments.parameters import identity
from headway_launch.experiments.start import parent_run
from headway_launch.runner.jobs import PlannedJob


@dataclass(frozen=True)
class StoredRun:
    """One run folder: its record, its configuration and its plan."""

    directory: Path
    record: RunRecord
    mapping: dict[str, Any]
    plan: RunPlan

    @classmethod
    def find(cls, root: Path, run_id: str) -> "StoredRun":
        """Return the run with identity `run_id`, or the only one with `run_id` as a part of its identity.

        Raises HeadwayError if there is no such run or its folder is incomplete.
        """
        return cls.read(root, find_run(root, run_id))

    @classmethod
    def read(cls, root: Path, directory: Path) -> "StoredRun":
        """Return the run stored in `directory`. Raises HeadwayError if the folder is incomplete."""
        mapping = read_configuration(directory)
        store = mapping.get("store", {})
        if not isinstance(store, Mapping):
            raise HeadwayError(
                f"{directory / 'config.yaml'}: store={store} is not a mapping; restore the file"
            )
        # The store may have been moved since the run was written.
        mapping["store"] = {**store, "root": str(root)}
        return cls(directory, RunRecord.read(directory), mapping, RunPlan.read(directory))

    @property
    def store(self) -> Path:
        """Folder of the store."""
        return Path(self.mapping["store"]["root"])

    @property
    def configuration(self) -> str:
        """The configuration without the seed, as JSON that is equal for all runs of one configuration."""
        rest = {key: value for key, value in self.mapping.items() if key != "seed"}
        return json.dumps(rest, sort_keys=True, default=str)

    @property
    def identity(self) -> str:
        """Key that is equal for two runs of a seed with the same learning curve.

        See `headway_launch.experiments.parameters.identity`.
        """
        return identity(self.mapping)

    @property
    def experiment(self) -> Experiment:
        """The experiment of the stored configuration. Raises HeadwayError if this version refuses it."""
        return resolve(self.mapping)

    def with_env_args(self, changed: Sequence[str]) -> tuple[Experiment, list[str]]:
        """Return the experiment on its environment with other arguments, `env.args.KEY=VALUE`, and what
        each changes.

        Raises HeadwayError for other keys, which concern training only.
        """
        for override in changed:
            if not override.startswith("env.args.") or "=" not in override:
                raise HeadwayError(
                    f"{override}: a trained policy keeps its own configuration; only env.args.KEY=VALUE can "
                    "be changed, and options such as --episodes and --rules"
                )
        mapping, changes = with_env_keys(self.mapping, changed)
        experiment = resolve(mapping)
        if changes and self._files_differ(experiment):
            # The arguments name other files on purpose: no notice that a file has changed since training.
            mapping["env"].pop("file_digest", None)
            experiment = resolve(mapping)
        return experiment, changes

    def _files_differ(self, experiment: Experiment) -> bool:
        try:
            return self.experiment.file_digest != experiment.file_digest
        except HeadwayError:  # this version refuses the configuration as it is stored
            return True


def jobs_to_resume(
    runs: Sequence[StoredRun], known: dict[str, PreparedEnv] | None = None
) -> list[tuple[PlannedJob, ...]]:
    """Return the jobs that resume `runs` in their original stacks, in batches of one configuration.

    Runs of one configuration share a batch; several runs of one seed go into successive batches. `known`: as
    in `Experiment.prepare`. Raises HeadwayError if a stack is incomplete: its seeds can only be resumed
    together.
    """
    batches: dict[tuple[str, int], list[StoredRun]] = {}
    times: Counter[tuple[str, int]] = Counter()
    # Oldest first: the runs of a stack began together and then share a batch.
    for run in sorted(runs, key=lambda run: run.record.started):
        seed = run.configuration, run.record.seed
        batches.setdefault((run.configuration, times[seed]), []).append(run)
        times[seed] += 1
    return [_batch_jobs(batch, known) for batch in batches.values()]


def _batch_jobs(runs: Sequence[StoredRun], known: dict[str, PreparedEnv] | None) -> tuple[PlannedJob, ...]:
    first = runs[0]
    seeds = [run.record.seed for run in runs]
    experiment = resolve({**first.mapping, "seed": seeds})
    experiment.require_unchanged_files()
    environment = experiment.prepare(known)
    by_seed = {run.record.seed: run for run in runs}
    stacks = list(dict.fromkeys(run.plan.stack for run in runs))
    jobs = []
    for stack in stacks:
        missing = [seed for seed in stack if seed not in by_seed]
        if missing:
            raise HeadwayError(
                f"seeds {', '.join(map(str, stack))} were trained in one stack and resume together only; "
                f"name the runs of seed {', '.join(map(str, missing))} too"
            )
        run_ids = tuple(by_seed[seed].record.run_id for seed in stack)
        iteration = min(by_seed[seed].record.durable_iteration for seed in stack)
        plan, config = by_seed[stack[0]].plan, experiment.config
        config = replace(config, rollout=replace(config.rollout, block=plan.block))
        job = PlannedJob.of(experiment, config, environment, stack)
        folders = [by_seed[seed].directory / CHECKPOINTS for seed in stack]
        if all(latest_iteration(folder) is None for folder in folders):  # it starts from the beginning
            job = job.with_parent(parent_run(experiment, job.training.plan.policy))
        jobs.append(replace(job, resumed=run_ids, iteration=iteration, workers=plan.workers))
    return tuple(jobs)


def with_env_keys(mapping: Mapping[str, Any], overrides: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Return a stored configuration with changed keys of `env`, and a description of each change.

    `overrides`: `env.KEY=VALUE` in Hydra's grammar, with one value. Raises HeadwayError for others, and for a
    key below a value that has no keys.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    changed, changes = deepcopy(dict(mapping)), []
    for override in overrides:
        key = override.partition("=")[0]
        require_grammar([override])
        parsed = OverridesParser.create().parse_override(override)
        if parsed.is_sweep_override():
            raise HeadwayError(f"{override}: give one value")
        _, *parents, name = key.split(".")
        place = changed.get("env")
        for parent in parents:
            place = place.setdefault(parent, {}) if isinstance(place, dict) else None
        if not isinstance(place, dict):
            raise HeadwayError(f"{override}: {key.rpartition('.')[0]} has no keys; give its value")
        trained = f" (trained with {place[name]})" if name in place else ""
        changes.append(f"{override}{trained}")
        place[name] = parsed.value()
    return changed, changes

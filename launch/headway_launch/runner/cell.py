"""One cell of a session: its stored runs, the work of its training processes, its rule episodes."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from headway.config.schema import plain
from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.policies.stored_spec import spec_json
from headway.store.checkpoint import latest_iteration
from headway.store.run_folder import CHECKPOINTS, Status, folders_of_seed, read_rules, status_of_all
from headway.store.session import Cell, Run, RunTakenError, SessionStore
from headway.training.loop import TrainingJob
from headway.wording import counted
from headway_launch.console.output import print_line, print_notice
from headway_launch.console.progress_display import CountedProgress
from headway_launch.experiments.parameters import cell_parameters, full_mapping, identity
from headway_launch.experiments.rules import rule_episodes
from headway_launch.runner.cores import CoreShares, workers_of
from headway_launch.runner.jobs import CellPlan, PlannedJob
from headway_launch.runner.results import SeedResult
from headway_launch.runner.stored_run import StoredRun

_TO_METRIC_NAME = str.maketrans(".:", "__")
Rules = Mapping[str, list[Row]]
_EVALUATION_SEED = "evaluation_seed"
"""Column of the evaluation seed in the rows of rules. Their `episode_seed` alone does not identify an
episode, because it counts from 0 for every evaluation seed."""


class SessionCell:
    """The work of a session for one cell."""

    def __init__(self, store: SessionStore, plan: CellPlan) -> None:
        experiment = plan.experiment
        self.plan, self.experiment, self.config = plan, experiment, experiment.config
        self.results = {folder.name: SeedResult.read(folder) for folder in plan.finished}
        """Result of each run that has ended, in this session or an earlier one, by the run's identity."""
        self.rules: Rules = {}
        self.touched = bool(plan.jobs)
        """Whether the session trains or stores anything in this cell."""
        self._store = store
        names = self.config.study, self.config.env.id, experiment.algo_name
        self._cell = Cell(store, *names, cell_parameters(experiment))

    @property
    def evaluation_key(self) -> str:
        """Identity of the episodes of the last evaluation and of the rules that are played on them."""
        evaluation, episodes = self.config.evaluation, self.config.evaluation.last_episodes
        return json.dumps(
            [self.experiment.evaluated_env, evaluation.seed, episodes, self.experiment.rules], default=str
        )

    def runs(self, planned: PlannedJob, shares: CoreShares) -> list[Run]:
        """Return the runs of a job, one per seed, newly created or resumed.

        Raises HeadwayError if the store cannot be written, and RunTakenError if another session trains, or
        has finished, one of them.
        """
        if planned.resumed:
            return self._store.resume(planned.resumed)
        import yaml

        experiment = planned.experiment
        plan = {
            "stack": list(planned.seeds),
            "rollout": plain(planned.config.rollout),
            "workers": workers_of(planned, shares),
            "spec": spec_json(planned.env_spec),
        }
        with self._store.claiming():
            self._require_untaken(planned.seeds)
            return [
                self._cell.begin_run(
                    seed,
                    yaml.safe_dump(full_mapping(experiment, [seed]), sort_keys=False),
                    plan,
                    iterations=self.config.iterations,
                    policies=str(getattr(experiment.algo_config, "policies", "")),
                    preset=self.config.preset,
                    candidate=self.config.candidate,
                )
                for seed in planned.seeds
            ]

    def _require_untaken(self, seeds: Sequence[int]) -> None:
        """Raise RunTakenError if another session has begun a run of these seeds since this one was planned.

        Runs that have failed or been killed since, and runs that cannot be read, do not count.
        """
        known, root = self.plan.known_runs, Path(self.config.store.root)
        if known is None:
            return
        wanted = identity(full_mapping(self.experiment, ()))
        taken = []
        for seed in seeds:
            for folder in folders_of_seed(root, self.config.study, self._cell.name, seed):
                if folder.name in known:
                    continue
                with suppress(HeadwayError):
                    run = StoredRun.read(root, folder)
                    if run.identity == wanted and run.record.settled_status in ("RUNNING", "FINISHED"):
                        taken.append(folder)
                        break
        if taken:
            raise RunTakenError(f"{taken[0].name} is a run of another session", taken)

    def training_job(self, planned: PlannedJob, runs: Sequence[Run], shares: CoreShares) -> TrainingJob:
        """Return the work of a job's training process."""
        return replace(
            planned.training,
            workers=workers_of(planned, shares),
            directories=tuple(str(run.directory) for run in runs),
            gates=tuple(str(run.gate) for run in runs),
            resume=bool(planned.resumed)
            and any(latest_iteration(run.directory / CHECKPOINTS) is not None for run in runs),
        )

    def play_rules(self, played: dict[str, Rules]) -> None:
        """Play the rules on the finished seeds' evaluation episodes and store the results.

        Cells with the same environment share one evaluation through `played`. If the session trains nothing
        here and stored results are complete, those are used instead.
        """
        if not any(result.status == "FINISHED" for result in self.results.values()):
            return
        kept = self._stored_rules()
        if not self.plan.jobs and kept is not None:
            self.rules = kept
            return
        key = self.evaluation_key
        if key not in played:
            episodes = self.config.evaluation.last_episodes
            played[key] = self._rule_rows(episodes) if self.experiment.rules else {}
        self.rules, self.touched = played[key], True
        self._cell.keep_rules(self.rules)

    def _rule_rows(self, episodes: int) -> Rules:
        """Play all rules for `episodes` evaluation episodes each and return their rows."""

        jobs, rules, seed = self.plan.jobs, self.experiment.rules, self.config.evaluation.seed
        print_line(f"{counted(len(rules), 'rule')} to play, {counted(episodes, 'episode')} each")
        prepared = jobs[0].training.plan.prepared if jobs else self.experiment.prepare().prepared
        with CountedProgress("episodes played", len(rules) * episodes) as progress:
            played = rule_episodes(self.experiment, prepared, rules, seed, episodes, progress)
        return {rule: [{**row, _EVALUATION_SEED: seed} for row in rows] for rule, rows in played.items()}

    def finish(self, statuses: Sequence[Status], metrics: Mapping[str, float]) -> None:
        """End the cell in MLflow with the session's `metrics`; `statuses`: one per job of the cell."""
        rules = {
            f"rules/{rule.translate(_TO_METRIC_NAME)}_return": fmean(float(row["return"]) for row in rows)
            for rule, rows in self.rules.items()
        }
        self._cell.finish(status_of_all(statuses), {**metrics, **rules})

    def in_order(self) -> list[SeedResult]:
        """Return the results in the order of the experiment's seeds."""
        order = {seed: place for place, seed in enumerate(self.config.seed)}
        return sorted(self.results.values(), key=lambda result: order.get(result.record.seed, 0))

    def _stored_rules(self) -> Rules | None:
        """Return the stored results of all rules on all evaluation episodes; None if any are missing or
        damaged."""
        try:
            kept = read_rules(Path(self.config.store.root), self.config.study, self._cell.name)
        except HeadwayError:
            print_notice(
                f"the stored episodes of the rules of {self._cell.name} are damaged: they are played again"
            )
            return None
        evaluation = self.config.evaluation
        seeds = [evaluation.seed] * evaluation.last_episodes
        rules: Rules = {rule: kept.get(rule, []) for rule in self.experiment.rules}
        if any([row.get(_EVALUATION_SEED) for row in rows] != seeds for rows in rules.values()):
            return None
        return rules

"""A session of a search: candidates are drawn in batches and trained from rung to rung, as runs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from headway.config.experiment import ExperimentConfig
from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import locked
from headway.store.index import RunIndex, RunRow
from headway.store.run_folder import search_database
from headway_launch.console.output import print_line
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.parameters import full_mapping, identity
from headway_launch.experiments.search import AlgorithmSearch
from headway_launch.runner.jobs import CellPlan
from headway_launch.runner.runner import EXIT_DONE, EXIT_STOPPED, Runner
from headway_launch.runner.stored_run import StoredRun
from headway_launch.studies.plan import StudyProgress, plan_cells
from headway_launch.studies.session import require_all_ended
from headway_launch.studies.trials import Trial, Trials

_LOCK_SECONDS = 5.0
_TRIES = 2
"""Trainings of a candidate until it has failed: the first may fail for a passing reason, such as memory."""


@dataclass(frozen=True)
class Candidate:
    """A drawn candidate with its experiment."""

    part: AlgorithmSearch
    trial: Trial
    experiment: Experiment

    @property
    def key(self) -> tuple[str, int]:
        """Label of its algorithm and its number."""
        return self.part.label, self.trial.number

    @property
    def label(self) -> str:
        """Name in progress displays and messages."""
        return f"{self.part.label}: {self.experiment.config.candidate}"

    @property
    def identity(self) -> str:
        """Key that is equal for candidates that drew the same values, which are trained once."""
        return identity(full_mapping(self.experiment, ()))

    def iteration_at(self, env_steps: int) -> int:
        """Return the iteration that reaches `env_steps`."""
        return -(-env_steps // self.experiment.config.iteration_steps)


class SearchSession:
    """The search of several algorithms with one budget, in one store."""

    def __init__(self, parts: Sequence[AlgorithmSearch], stored: bool = True) -> None:
        """`stored`: keep the candidates in the store; otherwise in memory, beside none.

        Raises HeadwayError as `Trials` does.
        """
        self.parts, self.search = tuple(parts), parts[0].search
        self.config: ExperimentConfig = parts[0].first.config
        self.root = Path(self.config.store.root)
        self.database = search_database(self.root, self.config.study)
        self._trials = {
            part.label: Trials(part, self.database.resolve() if stored else None) for part in parts
        }
        self._experiments: dict[tuple[str, int], Experiment] = {}

    def require_settings(self) -> None:
        """Raise HeadwayError if the search has begun with other settings."""
        for trials in self._trials.values():
            trials.require_settings()

    def run(self, debug: bool = False) -> int:
        """Train all candidates that have not ended; return the exit code.

        Raises HeadwayError if the search has begun with other settings, if another session runs it, if a run
        cannot be trained, and if all candidates of a batch fail.
        """
        self.require_settings()
        lock = self.database.with_suffix(".lock")
        # A session that was just killed holds its lock until it has ended.
        with locked(lock, _LOCK_SECONDS, "another session ran this search"):
            batches = max(len(part.batches) for part in self.parts)
            if self.search.sampler != "tpe":
                # Values that do not go together are found before anything is trained.
                for place in range(batches):
                    self.drawn(place)
            for place in range(batches):
                batch = self.drawn(place)
                if all(candidate.trial.state != "RUNNING" for candidate in batch):
                    continue
                code = self._train_batch(batch, f"batch {place + 1} of {batches}", debug)
                if code != EXIT_DONE:
                    return code
        return EXIT_DONE

    def drawn(self, place: int) -> list[Candidate]:
        """Return the candidates of a batch, newly drawn or stored, those of all algorithms."""
        found = []
        for part in self.parts:
            if place < len(part.batches):
                numbers = part.batches[place]
                trials = self._trials[part.label].draw(numbers.stop)
                found += [self._candidate(part, trials[number]) for number in numbers]
        return found

    def candidates(self, part: AlgorithmSearch) -> list[Candidate]:
        """Return the candidates of an algorithm drawn so far, within its budget."""
        return [self._candidate(part, trial) for trial in self._trials[part.label].all()[: part.candidates]]

    def runs_of(self, candidates: Sequence[Candidate]) -> dict[str, tuple[RunRow, ...]]:
        """Return the runs of each candidate that has any, the best one per seed, by its `identity`."""
        rows = RunIndex(self.root).rows(self.config.study)
        by_name = {row.run_id: row for row in rows}
        return {
            candidate.identity: tuple(by_name[run.record.run_id] for run in _runs(found))
            for candidate in candidates
            if (found := StudyProgress.of(self.root, candidate.experiment, rows)).run_ids
        }

    def _candidate(self, part: AlgorithmSearch, trial: Trial) -> Candidate:
        key = part.label, trial.number
        if key not in self._experiments:
            self._experiments[key] = part.experiment(trial.number, trial.values)
        return Candidate(part, trial, self._experiments[key])

    def _train_batch(self, batch: Sequence[Candidate], name: str, debug: bool) -> int:
        """Train a batch from rung to rung, the best part of it to the end; store scores and states."""
        states: dict[tuple[str, int], str] = {}
        left = [candidate for candidate in batch if candidate.trial.state != "FAIL"]
        for rung, env_steps in enumerate(self.search.ends):
            counts = ", ".join(
                f"{sum(candidate.part is part for candidate in left)} of {part.label}" for part in self.parts
            )
            print_line(f"headway: {name}, to step {env_steps:,}: candidates {counts}")
            waiting, scores = left, dict[tuple[str, int], float]()
            for _ in range(_TRIES):
                if waiting:
                    if (code := self._train(waiting, env_steps, debug)) != EXIT_DONE:
                        return code
                    scores |= self._scores(waiting, env_steps)
                    waiting = [each for each in waiting if each.key not in scores]
            for candidate in left:
                if (score := scores.get(candidate.key)) is None:
                    states[candidate.key] = "FAIL"
                else:
                    states[candidate.key] = "COMPLETE" if env_steps == self.search.env_steps else "PRUNED"
                    self._trials[candidate.part.label].report(candidate.trial.number, env_steps, score)
            if not scores:
                raise HeadwayError(
                    f"all candidates of {name} have failed; their folders in "
                    f"{self.root / self.config.study} have the tracebacks; mend the cause and repeat this"
                )
            left = self._best(batch, scores, rung)
        for (label, number), state in states.items():
            self._trials[label].end(number, state)
        return EXIT_DONE

    def _best(
        self, batch: Sequence[Candidate], scores: Mapping[tuple[str, int], float], rung: int
    ) -> list[Candidate]:
        """Return the candidates of each algorithm that are continued after a rung, of equals the earlier."""
        kept = set[tuple[str, int]]()
        for part in self.parts:
            own = [candidate.key for candidate in batch if candidate.part is part]
            scored = [key for key in own if key in scores]
            count = [*self.search.left_at(len(own)), 0][rung + 1]
            kept |= set(sorted(scored, key=lambda key: self.search.loss(scores[key]))[:count])
        return [candidate for candidate in batch if candidate.key in kept]

    def _train(self, candidates: Sequence[Candidate], env_steps: int, debug: bool) -> int:
        """Train candidates up to `env_steps`, from their checkpoints on; return the exit code.

        A candidate that fails does not count: it has no score.
        """
        distinct = {candidate.identity: candidate for candidate in reversed(candidates)}
        todo = list(reversed(distinct.values()))
        rows = RunIndex(self.root).rows(self.config.study)
        progress = [StudyProgress.of(self.root, candidate.experiment, rows) for candidate in todo]
        require_all_ended(self.config.study, [run.directory for each in progress for run in each.elsewhere])
        planned = plan_cells(progress, [candidate.label for candidate in todo])
        cells = [_until(cell, candidate, env_steps) for cell, candidate in zip(planned, todo, strict=True)]
        if not (cells := [cell for cell in cells if cell.jobs]):
            return EXIT_DONE
        runner = Runner(cells, debug, plan_kept=True)
        if runner.run(report=False) == EXIT_STOPPED:
            return EXIT_STOPPED
        require_all_ended(self.config.study, runner.left_to_others())
        return EXIT_DONE

    def _scores(self, candidates: Sequence[Candidate], env_steps: int) -> dict[tuple[str, int], float]:
        """Return the score of each candidate at `env_steps`, by label and number; none of failed ones."""
        rows = RunIndex(self.root).rows(self.config.study)
        scores = {}
        for candidate in candidates:
            runs = _runs(StudyProgress.of(self.root, candidate.experiment, rows))
            score = self._score(candidate, runs, env_steps)
            if math.isfinite(score):
                scores[candidate.key] = score
        return scores

    def _score(self, candidate: Candidate, runs: Sequence[StoredRun], env_steps: int) -> float:
        """Return the mean over runs of the metric's last 20% up to `env_steps`; NaN if one ended before."""
        from headway.stats.curves import final_reward
        from headway.store.parquet_log import read_curve, read_rows

        config, last = candidate.experiment.config, candidate.iteration_at(env_steps)
        ended = [run for run in runs if run.record.durable_iteration >= last]
        if len(ended) < len(config.seed):
            return math.nan
        values = []
        for run in ended:
            limit = last * config.iteration_steps
            curve = read_curve(run.directory, self.search.curve)
            points = {steps: value for steps, value in curve.items() if steps <= limit}
            if not points:
                known = {name for row in read_rows(run.directory, "curve") for name in row if "/" in name}
                raise HeadwayError(
                    f"metric={self.search.metric}: curves have no {self.search.curve!r}; "
                    f"{suggestion(self.search.curve, known)}"
                )
            if not all(map(math.isfinite, points.values())):
                return math.nan
            values.append(final_reward(list(points), list(points.values())))
        return sum(values) / len(values)


def _runs(progress: StudyProgress) -> tuple[StoredRun, ...]:
    return (*progress.finished, *progress.unfinished, *progress.elsewhere)


def _until(cell: CellPlan, candidate: Candidate, env_steps: int) -> CellPlan:
    """Return the work of a cell up to `env_steps`, where jobs pause; without those that have been there."""
    last = candidate.iteration_at(env_steps)
    if last >= candidate.experiment.config.iterations:
        return cell
    return replace(
        cell,
        jobs=tuple(
            replace(job, training=replace(job.training, pause_after=last))
            for job in cell.jobs
            if job.iteration < last
        ),
    )

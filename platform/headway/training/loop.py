"""The training loop: collect, learn, evaluate, checkpoint; the same for every algorithm."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.config.experiment import ExperimentConfig
from headway.contracts import (
    AsynchronousLearner,
    BatchedEnv,
    EnvSpec,
    HeadwayError,
    Learner,
    LearnerWithReplay,
)
from headway.contracts.acting_policy import ActingPolicy
from headway.events import (
    LABELS,
    CheckpointSaved,
    EvaluationFinished,
    Event,
    Finished,
    IterationFinished,
    Notice,
    Row,
    Started,
    Usage,
)
from headway.rollout.backends import open_collector, open_contributors
from headway.rollout.collector import Backend
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode
from headway.rollout.workers.async_worker import AsynchronousPlan, MakeContributor
from headway.rollout.workers.shared_memory import give_back_memory
from headway.rollout.workers.usage import OwnUsage
from headway.store.checkpoint import (
    checkpoint_bytes,
    load_to_go_on,
    remove_experience,
    write_checkpoint,
    write_experience,
)
from headway.store.checkpoint_fit import require_fitting
from headway.store.parquet_log import RunLog
from headway.store.run_folder import CHECKPOINTS
from headway.training.modes import AsynchronousMode, Mode, SynchronousMode


@dataclass(frozen=True)
class TrainingJob:
    """One stack of seeds to train in one process. Picklable."""

    make_env: Callable[[Any, int], BatchedEnv]
    """The environment entry's `make`."""
    preload: tuple[str, ...]
    """The environment entry's."""
    prepared: Any
    """What the environment entry's `prepare` gave for the experiment's arguments."""
    spec: EnvSpec
    """What is learned from: the training environment's."""
    make_policy: Callable[[Any, EnvSpec], ActingPolicy]
    """The algorithm entry's `acting_policy`."""
    make_learner: Callable[[Any, EnvSpec, Sequence[int], str], Learner]
    """The algorithm entry's `learner`."""
    algo_config: Any
    seeds: tuple[int, ...]
    config: ExperimentConfig
    workers: int
    directories: tuple[str, ...]
    """Run folders, one a seed."""
    gates: tuple[str, ...] = ()
    """Through which the run folders are written, one a seed (see `headway.store.fencing`); empty: there are
    none."""
    resume: bool = False
    training_prepared: Any = None
    """What `prepare` gave for the training arguments; None: the same."""
    make_contributor: MakeContributor | None = None
    """The algorithm entry's `contributor`; None: it learns in step."""
    contributor_preload: tuple[str, ...] = ()
    """The algorithm entry's `preload`."""

    @property
    def checkpoints(self) -> tuple[Path, ...]:
        """Folders of checkpoints, one a seed."""
        return tuple(Path(directory, CHECKPOINTS) for directory in self.directories)

    @property
    def ways(self) -> tuple[Path | None, ...]:
        """Its gates, one a seed; None where there are none."""
        return tuple(map(Path, self.gates)) or (None,) * len(self.directories)

    def plan(self) -> RolloutPlan:
        """What decides this job's draws."""
        policy = self.make_policy(self.algo_config, self.spec)
        return RolloutPlan.of(
            self.config.rollout, self.make_env, self.preload, self.prepared, self.spec, policy, self.seeds,
            self.training_prepared,
        )  # fmt: skip


def train(job: TrainingJob, report: Callable[[Event], None], should_stop: Callable[[], bool]) -> None:
    """Train one job to its budget, or until `should_stop`; every step of the way is reported.

    Raises HeadwayError for what the user can mend.
    """
    import torch

    # Two torch threads on two busy cores were seen to be 4 to 12 times slower than one: they spin.
    torch.set_num_threads(1)
    training = _Training(job, report)
    try:
        training.run(should_stop)
    finally:
        training.collector.close()


class _Training:
    """The state of a training process."""

    def __init__(self, job: TrainingJob, report: Callable[[Event], None]) -> None:
        self.job, self.config, self.report = job, job.config, report
        folders = zip(job.directories, job.ways, strict=True)
        self.logs = [RunLog(Path(directory), gate) for directory, gate in folders]
        self.learner = job.make_learner(job.algo_config, job.spec, job.seeds, job.config.device)
        self.collector, self.mode = _opened(job, self.learner, lambda line: report(Notice(line)))
        self.iteration = 0
        self.saved_iteration = -1
        self.seconds_before = 0.0
        self.episodes_restarted = False
        self.store_s = 0.0
        self.started = time.monotonic()
        self.own_usage = OwnUsage()

    @property
    def env_steps(self) -> int:
        """Environment steps of each seed so far."""
        return self.iteration * self.config.rollout.copies * self.config.rollout.steps

    def run(self, should_stop: Callable[[], bool]) -> None:
        """From the start, or the newest checkpoint, to the budget or a request to stop."""
        total = self.config.iterations
        if self.job.resume:
            self._resume()
        else:
            # Rows of a session that died before its first checkpoint, if there was one.
            for log in self.logs:
                log.rewind(-1)
            self.collector.begin()
        give_back_memory()
        process_ids = (os.getpid(), *self.collector.process_ids())
        self.report(Started(self.iteration, process_ids, self.episodes_restarted))
        if self.saved_iteration < 0:
            self._write_curve(self._labelled([{} for _ in self.job.seeds]), self._evaluate(final=False))
        while self.iteration < total and not should_stop():
            self._iterate(total)
            if self.iteration % self.config.store.checkpoint_every == 0 or self.iteration == total:
                self._checkpoint()
        if self.saved_iteration < self.iteration:
            self._checkpoint()
        if self.iteration >= total:
            # Here, and not with the last checkpoint: the session before may have died just after that.
            remove_experience(self.job.checkpoints[0], self.job.ways[0])
        stopped = self.iteration < total
        self.report(Finished(self.iteration, stopped, self._usage(), self.store_s))

    def _iterate(self, total: int) -> None:
        done = self.mode.iterate(self.iteration + 1, self.iteration / total)
        self.iteration += 1
        seconds = {"time/collect_s": done.collect_s, "time/learn_s": done.learn_s}
        rows = self._labelled(self._training_rows(done.metrics, done.episodes, seconds))
        self._log_episodes(done.episodes)
        self.report(IterationFinished(self.iteration, self.env_steps, self._usage(), tuple(rows)))
        due = self.iteration == total or self._reached(self.config.evaluation.every)
        self._write_curve(rows, self._evaluate(final=self.iteration == total) if due else None)

    def _reached(self, steps: int) -> bool:
        """Whether the last iteration reached or passed a multiple of `steps` environment steps."""
        rollout = self.config.rollout
        return self.env_steps // steps > (self.env_steps - rollout.copies * rollout.steps) // steps

    def _training_rows(
        self, metrics: Mapping[str, NDArray[np.float64]], episodes: list[Episode], seconds: Row
    ) -> list[dict[str, float | int | str]]:
        rows = []
        for r in range(len(self.job.seeds)):
            row: dict[str, float | int | str] = {name: float(value[r]) for name, value in metrics.items()}
            row.update(_means("training", [episode.row for episode in episodes if episode.replica == r]))
            row.update(seconds)
            rows.append(row)
        return rows

    def _labelled(self, rows: list[dict[str, float | int | str]]) -> list[dict[str, float | int | str]]:
        label = {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "wall_s": self.seconds_before + time.monotonic() - self.started,
        }
        return [{**label, **row} for row in rows]

    def _evaluate(self, final: bool) -> list[dict[str, float | int | str]]:
        """Evaluate in every mode, report, log the episodes; one row of means a seed."""
        evaluation, parameters = self.config.evaluation, self.learner.acting_parameters()
        count = evaluation.last_episodes if final else evaluation.episodes
        means: list[dict[str, float | int | str]] = [{} for _ in self.job.seeds]
        for mode in evaluation.modes:
            episodes = self.collector.evaluate(evaluation.seed, count, mode == "greedy", parameters)
            curve = []
            for log, mean, played in zip(self.logs, means, episodes, strict=True):
                label = {"iteration": self.iteration, "env_steps": self.env_steps, "mode": mode}
                log.append("evaluation", [{**label, "final": int(final), **row} for row in played])
                # A curve's points are means over the same days, also where the last one has more.
                of_mode = _means(f"evaluation_{mode}", played[: evaluation.episodes])
                mean.update(of_mode)
                curve.append(self._labelled([of_mode])[0])
            self.report(
                EvaluationFinished(self.iteration, self.env_steps, mode, final, self._usage(), tuple(curve))
            )
        return means

    def _write_curve(
        self, rows: list[dict[str, float | int | str]], evaluated: list[dict[str, float | int | str]] | None
    ) -> None:
        began = time.monotonic()
        for r, log in enumerate(self.logs):
            log.append("curve", [{**rows[r], **(evaluated[r] if evaluated else {})}])
        self.store_s += time.monotonic() - began

    def _log_episodes(self, episodes: list[Episode]) -> None:
        began = time.monotonic()
        label = {"iteration": self.iteration, "env_steps": self.env_steps}
        for r, log in enumerate(self.logs):
            log.append("episodes", [{**label, **e.row} for e in episodes if e.replica == r])
        self.store_s += time.monotonic() - began

    def _checkpoint(self) -> None:
        """All logs first: a checkpoint never knows more than they hold. Each seed's folder gets the same
        one, of the whole stack, and one may be all there is when a stack is killed between two writes. What
        a learner replays is written once, before the checkpoint that needs it, and goes when training is
        over."""
        began = time.monotonic()
        learner = self.learner
        going_on = self.iteration < self.config.iterations
        experience = learner.experience() if isinstance(learner, LearnerWithReplay) and going_on else None
        state = {
            "learner": self.learner.state_dict(),
            "acting": self.learner.acting_parameters(),
            "snapshots": self.collector.snapshot(),
            "iteration": self.iteration,
            "seconds": self.seconds_before + time.monotonic() - self.started,
            "has_experience": experience is not None,
        }
        for log in self.logs:
            log.commit(self.iteration)
        content = checkpoint_bytes(state)
        if experience is not None:
            kept = checkpoint_bytes(experience)
            write_experience(self.job.checkpoints[0], self.iteration, kept, self.job.ways[0])
        for directory, gate in zip(self.job.checkpoints, self.job.ways, strict=True):
            write_checkpoint(directory, self.iteration, content, gate)
        self.saved_iteration = self.iteration
        self.store_s += time.monotonic() - began
        self.report(CheckpointSaved(self.iteration))

    def _resume(self) -> None:
        iteration, state, notices = load_to_go_on(*self.job.checkpoints)
        for line in notices:
            self.report(Notice(line))
        job, policy = self.job, self.job.make_policy(self.job.algo_config, self.job.spec)
        folder = Path(job.directories[0])
        require_fitting(state["acting"], policy, len(job.seeds), self.config.env.id, folder)
        self.iteration = self.saved_iteration = iteration
        self.seconds_before = state["seconds"]
        self.learner.load_state_dict(state["learner"])
        if isinstance(self.learner, LearnerWithReplay) and state["experience"] is not None:
            self.learner.load_experience(state["experience"])
        if not self.mode.repeats:
            line = "its workers' contributions are applied as they come, and never twice in the same order"
            self.report(Notice(f"{line}: after {iteration} its curve is not that of a run never stopped"))
        self.collector.restore(state["snapshots"], iteration)
        self.episodes_restarted = any(snapshot is None for snapshot in state["snapshots"])
        if self.episodes_restarted:
            name = self.job.spec.name
            self.report(Notice(f"{name} keeps no snapshots: its episodes start anew after {iteration}"))
        for log in self.logs:
            log.rewind(iteration)

    def _usage(self) -> Usage:
        return self.own_usage.read() + self.collector.usage()


def _opened(job: TrainingJob, learner: Learner, notify: Callable[[str], None]) -> tuple[Backend, Mode]:
    """Workers, started, and how they and the learner go together."""
    backend, plan = job.config.backend, job.plan()
    if job.make_contributor is None:
        collector = open_collector(backend, plan, job.workers, notify)
        return collector, SynchronousMode(learner, collector)
    if not isinstance(learner, AsynchronousLearner):
        raise HeadwayError(
            f"the entry of algo={job.config.algo.get('name')} has a contributor, but its learner is no "
            "headway.contracts.AsynchronousLearner; give it what is missing, or leave the contributor out"
        )
    together = AsynchronousPlan(plan, job.make_contributor, job.algo_config, job.contributor_preload)
    contributors = open_contributors(backend, together, notify)
    return contributors, AsynchronousMode(learner, contributors, job.config.iterations)


def _means(group: str, rows: list[Row]) -> dict[str, float | int | str]:
    """Means of an episode table's numbers, named `group/column`; nothing where there are no episodes."""
    if not rows:
        return {}
    columns = [name for name in rows[0] if name not in LABELS]
    return {f"{group}/{name}": float(np.mean([float(row[name]) for row in rows])) for name in columns}

"""The training loop of every algorithm: sample, learn, evaluate and write checkpoints."""

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
    AnchoredLearner,
    AsynchronousLearner,
    ContinuingLearner,
    EnvSpec,
    HeadwayError,
    Learner,
    LearnerWithReplay,
    StartingLearner,
)
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
from headway.rollout.workers.shared_memory import give_back_memory
from headway.rollout.workers.usage import OwnUsage
from headway.store.checkpoint import (
    checkpoint_bytes,
    load_for_resume,
    load_latest,
    remove_replay,
    require_same_shapes,
    rewind_checkpoints,
    write_checkpoint,
)
from headway.store.parquet_log import RunLog
from headway.store.run_folder import CHECKPOINTS
from headway.training.best_policies import BestPolicies
from headway.training.modes import AsynchronousMode, Mode, SynchronousMode


@dataclass(frozen=True)
class ParentRun:
    """The run that training starts from."""

    directory: str
    """Run folder."""
    replica: int
    """Index of its seed in the stack that its checkpoints contain."""
    replicas: int
    """Number of seeds in that stack."""
    with_critic: bool
    """Whether its critic is taken over too."""


@dataclass(frozen=True)
class TrainingJob:
    """One stack of seeds to train in one process. Picklable."""

    plan: RolloutPlan
    """Environment, policy, seeds and sizes of the rollouts."""
    make_learner: Callable[[Any, EnvSpec, Sequence[int], str], Learner]
    """The algorithm entry's `learner`."""
    algo_config: Any
    config: ExperimentConfig
    """The configuration as trained; its seeds are those of `plan`."""
    workers: int = 1
    """Rollout workers."""
    directories: tuple[str, ...] = ()
    """Run folders, one per seed; empty before they exist."""
    gates: tuple[str, ...] = ()
    """Gates through which the run folders are written, one per seed (see `headway.store.fencing`); empty: no
    gates."""
    resume: bool = False
    pause_after: int | None = None
    """Iteration after which training stops, with a checkpoint, as if it were asked to; None: never."""
    parent: ParentRun | None = None
    """None: training starts from random parameters or from the plan's rule."""
    later_plans: tuple[RolloutPlan, ...] = ()
    """Plans of the stages after the first, which has `plan`; they differ in the training environment."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the stack."""
        return self.plan.seeds

    @property
    def spec(self) -> EnvSpec:
        """Specification of the training environment, with actions in the units of the policies."""
        return self.plan.spec

    @property
    def checkpoints(self) -> tuple[Path, ...]:
        """Checkpoint folders, one per seed."""
        return tuple(Path(directory, CHECKPOINTS) for directory in self.directories)

    @property
    def gate_paths(self) -> tuple[Path | None, ...]:
        """Paths of the gates, one per seed; None for a seed without a gate."""
        return tuple(map(Path, self.gates)) or (None,) * len(self.directories)


def train(job: TrainingJob, report: Callable[[Event], None], should_stop: Callable[[], bool]) -> None:
    """Train one job until its budget is used or `should_stop` returns True, and report every event.

    Raises HeadwayError for errors that the user can correct.
    """
    import torch

    # On two busy cores two torch threads were measured 4 to 12 times slower than one, because they spin.
    torch.set_num_threads(1)
    training = _Training(job, report)
    try:
        training.run(should_stop)
    finally:
        training.backend.close()


class _Training:
    """The training loop's state."""

    def __init__(self, job: TrainingJob, report: Callable[[Event], None]) -> None:
        self.job, self.config, self.report = job, job.config, report
        folders = zip(job.directories, job.gate_paths, strict=True)
        self.logs = [RunLog(Path(directory), gate) for directory, gate in folders]
        self.learner = job.make_learner(job.algo_config, job.spec, job.seeds, job.config.device)
        _require_start(job, self.learner)
        self.best = BestPolicies(len(job.seeds))
        self.iteration = 0
        """Iterations finished."""
        self.saved_iteration = -1
        """Iteration of the newest checkpoint; -1: none."""
        self.seconds_before = 0.0
        """Wall time of earlier sessions of the run."""
        self.snapshots: list[Any] = []
        """Snapshots of the checkpoint that training resumes from, until their episodes are continued."""
        self.episodes_restarted = False
        self.store_s = 0.0
        if job.resume:
            self._load_checkpoint()
        self.stage = self.config.stage_after(self.iteration)
        self.ended = Usage()
        """Usage of the workers of stages that have ended."""
        self.backend, self.mode = self._open()
        self.started = time.monotonic()
        self.own_usage = OwnUsage()

    @property
    def env_steps(self) -> int:
        """Environment steps per seed so far."""
        return self.iteration * self.config.iteration_steps

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Train from the start or the newest checkpoint until the budget is used or a stop is requested."""
        total = self.config.iterations
        last = total if self.job.pause_after is None else min(self.job.pause_after, total)
        if self.job.resume:
            self._resume()
        else:
            # Drop the rows of a session that died before its first checkpoint.
            for log in self.logs:
                log.rewind(-1)
            self._start()
            self.backend.begin()
        give_back_memory()
        process_ids = (os.getpid(), *self.backend.process_ids())
        self.report(Started(self.iteration, process_ids, self.episodes_restarted))
        if self.saved_iteration < 0:
            self._write_curve(self._with_labels([{} for _ in self.job.seeds]), self._evaluate(final=False))
        while self.iteration < last and not should_stop():
            self._iterate(total)
            ends = self.iteration in self.config.stage_ends
            if ends or self.iteration % self.config.store.checkpoint_every == 0:
                self._checkpoint()
            # After the checkpoint, whose snapshots belong to the workers of the stage that ends.
            if ends and self.iteration < total:
                self._enter_next_stage()
        if self.saved_iteration < self.iteration:
            self._checkpoint()
        if self.iteration >= total:
            # Not part of the last checkpoint: an earlier session may have died just after writing that.
            remove_replay(self.job.checkpoints[0], self.job.gate_paths[0])
        stopped = self.iteration < total
        self.report(Finished(self.iteration, stopped, self._usage(), self.store_s))

    def _open(self) -> tuple[Backend, Mode]:
        plan = (self.job.plan, *self.job.later_plans)[self.stage]
        return _open_mode(self.job, plan, self.learner, lambda line: self.report(Notice(line)))

    def _enter_next_stage(self) -> None:
        """Replace the workers by those of the next stage."""
        # Workers of an ended stage still count in CPU seconds, but no longer in memory.
        self.ended += Usage(self.backend.usage().cpu_seconds)
        self.backend.close()
        self.stage += 1
        self.backend, self.mode = self._open()
        self._begin_stage()

    def _begin_stage(self) -> None:
        """Start the first episodes of a stage after the first."""
        self.backend.begin()
        if isinstance(self.learner, ContinuingLearner):
            self.learner.begin_episodes()

    def _iterate(self, total: int) -> None:
        done = self.mode.iterate(self.iteration + 1, self.iteration / total)
        self.iteration += 1
        times = {"time/collect_s": done.collect_s, "time/learn_s": done.learn_s}
        rows = self._with_labels(self._training_rows(done.metrics, done.episodes, times))
        self._log_episodes(done.episodes)
        at = self.iteration, self.env_steps
        self.report(IterationFinished(*at, self._usage(), self._wall_s(), done.collect_s, done.learn_s))
        due = self.config.evaluates_after(self.iteration)
        self._write_curve(rows, self._evaluate(final=self.iteration == total) if due else None)

    def _training_rows(
        self, metrics: Mapping[str, NDArray[np.float64]], episodes: list[Episode], seconds: Row
    ) -> list[Row]:
        return [
            {
                **{name: float(value[r]) for name, value in metrics.items()},
                **_episode_means("training", [episode.row for episode in episodes if episode.replica == r]),
                **seconds,
            }
            for r in range(len(self.job.seeds))
        ]

    def _with_labels(self, rows: Sequence[Row]) -> list[Row]:
        label = {"iteration": self.iteration, "env_steps": self.env_steps, "wall_s": self._wall_s()}
        return [{**label, **row} for row in rows]

    def _evaluate(self, final: bool) -> list[Row]:
        """Evaluate in every mode, log the episodes and report; return one row of means per seed.

        The first mode decides which policies are the best so far.
        """
        evaluation, parameters = self.config.evaluation, self.learner.acting_parameters()
        count = evaluation.last_episodes if final else evaluation.episodes
        means: list[Row] = [{} for _ in self.job.seeds]
        for mode in evaluation.modes:
            episodes = self.backend.evaluate(evaluation.seed, count, mode == "greedy", parameters)
            group = f"evaluation_{mode}"
            for log, played in zip(self.logs, episodes, strict=True):
                label = {"iteration": self.iteration, "env_steps": self.env_steps, "mode": mode}
                log.append("evaluation", [{**label, "final": int(final), **row} for row in played])
            # Every point of a curve is a mean over the same episodes; the last evaluation has more.
            of_mode = [_episode_means(group, played[: evaluation.episodes]) for played in episodes]
            returns = [row[f"{group}/return"] for row in of_mode]
            means = [{**mean, **row} for mean, row in zip(means, of_mode, strict=True)]
            if mode == evaluation.modes[0]:
                self.best.offer(returns, self.iteration, parameters)
            shown = float(np.mean(returns))
            self.report(EvaluationFinished(self.iteration, self.env_steps, mode, self._usage(), shown))
        return means

    def _write_curve(self, rows: Sequence[Row], evaluated: Sequence[Row] | None) -> None:
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
        """Commit the logs, then write the same checkpoint of the whole stack to every seed's folder.

        Replay data are written once per stack, before the checkpoint that needs them. The order matters if
        the process is killed between two writes: a checkpoint must not be ahead of the logs, and the copy in
        any one folder is enough to resume.
        """
        began = time.monotonic()
        learner = self.learner
        unfinished = self.iteration < self.config.iterations
        replay = learner.replay_state() if isinstance(learner, LearnerWithReplay) and unfinished else None
        state = {
            "learner": self.learner.state_dict(),
            "acting": self.learner.acting_parameters(),
            "best": self.best.state_dict(),
            "snapshots": self.backend.snapshot(),
            "iteration": self.iteration,
            "seconds": self._wall_s(),
            "has_experience": replay is not None,
        }
        for log in self.logs:
            log.commit(self.iteration)
        content = checkpoint_bytes(state)
        if replay is not None:
            kept = checkpoint_bytes(replay)
            gate = self.job.gate_paths[0]
            write_checkpoint(self.job.checkpoints[0], self.iteration, kept, gate, "experience")
        for directory, gate in zip(self.job.checkpoints, self.job.gate_paths, strict=True):
            write_checkpoint(directory, self.iteration, content, gate)
        self.saved_iteration = self.iteration
        self.store_s += time.monotonic() - began
        self.report(CheckpointSaved(self.iteration))

    def _start(self) -> None:
        """Take over the parent run's policies, if there is one."""
        parent, learner = self.job.parent, self.learner
        if parent is None:
            return
        assert isinstance(learner, StartingLearner)
        _, state, notices = load_latest(Path(parent.directory) / CHECKPOINTS)
        started = learner.start_from(state["learner"], parent.replica, parent.replicas, parent.with_critic)
        for line in (*notices, *started):
            self.report(Notice(line))

    def _load_checkpoint(self) -> None:
        iteration, state, notices = load_for_resume(*self.job.checkpoints)
        for line in notices:
            self.report(Notice(line))
        job, folder = self.job, Path(self.job.directories[0])
        require_same_shapes(state["acting"], job.plan.policy, len(job.seeds), self.config.env.id, folder)
        self.iteration = self.saved_iteration = iteration
        self.seconds_before = state["seconds"]
        self.learner.load_state_dict(state["learner"])
        if "best" in state:  # checkpoints of earlier versions have none
            self.best.load_state_dict(state["best"])
        if isinstance(self.learner, LearnerWithReplay) and state["replay"] is not None:
            self.learner.load_replay_state(state["replay"])
        self.snapshots = state["snapshots"]

    def _resume(self) -> None:
        if not self.mode.deterministic:
            line = "workers' contributions are applied in order of arrival, which differs from run to run"
            self.report(
                Notice(
                    f"{line}: after iteration {self.iteration} its curve differs from that of an "
                    "uninterrupted run"
                )
            )
        self._resume_episodes()
        for log, directory, gate in zip(self.logs, self.job.checkpoints, self.job.gate_paths, strict=True):
            log.rewind(self.iteration)
            rewind_checkpoints(directory, self.iteration, gate)

    def _resume_episodes(self) -> None:
        """Continue the episodes of the checkpoint, or begin those of a stage that follows it."""
        snapshots, self.snapshots = self.snapshots, []
        if self.iteration in self.config.stage_ends[:-1]:
            self._begin_stage()
            return
        self.backend.restore(snapshots, self.iteration)
        self.episodes_restarted = any(snapshot is None for snapshot in snapshots)
        if self.episodes_restarted:
            name, iteration = self.job.spec.name, self.iteration
            self.report(Notice(f"{name} has no snapshots: its episodes restart after iteration {iteration}"))

    def _wall_s(self) -> float:
        """Seconds of training so far, earlier sessions included."""
        return self.seconds_before + time.monotonic() - self.started

    def _usage(self) -> Usage:
        return self.own_usage.read() + self.backend.usage() + self.ended


def _require_start(job: TrainingJob, learner: Learner) -> None:
    """Raise HeadwayError if the learner lacks a method that the start needs."""
    starts = job.plan.rule is not None or job.parent is not None
    entry = f"the entry of algo={job.config.algo.get('name')}"
    if starts and not isinstance(learner, StartingLearner):
        raise HeadwayError(
            f"{entry} has starts=True, but its learner is not a headway.contracts.StartingLearner; add the "
            "missing methods, or leave out start"
        )
    keys = " and ".join(f"start.{key}" for key in job.config.start.anchors)
    if keys and not isinstance(learner, AnchoredLearner):
        raise HeadwayError(
            f"{entry} allows {keys}, but its learner is not a headway.contracts.AnchoredLearner; add its "
            f"method `anchor`, or leave out {keys}"
        )


def _open_mode(
    job: TrainingJob, plan: RolloutPlan, learner: Learner, notify: Callable[[str], None]
) -> tuple[Backend, Mode]:
    """Start the workers; return the backend and the mode in which it works with the learner.

    Raises HeadwayError if the algorithm's contributor and learner do not match.
    """
    backend = job.config.backend
    if plan.make_contributor is None:
        collector = open_collector(backend, plan, job.workers, notify)
        config = job.config
        mode = SynchronousMode(learner, collector, job.plan.rule_iterations, config.start, config.iterations)
        return collector, mode
    if not isinstance(learner, AsynchronousLearner):
        raise HeadwayError(
            f"the entry of algo={job.config.algo.get('name')} has a contributor, but its learner is not "
            "a headway.contracts.AsynchronousLearner; add the missing methods, or leave the contributor out"
        )
    contributors = open_contributors(backend, plan, notify)
    return contributors, AsynchronousMode(learner, contributors, job.config.iterations)


def _episode_means(group: str, rows: Sequence[Row]) -> dict[str, float]:
    """Return the means of an episode table's metrics by `group/column`; empty without episodes."""
    if not rows:
        return {}
    columns = [name for name in rows[0] if name not in LABELS]
    return {f"{group}/{name}": float(np.mean([float(row[name]) for row in rows])) for name in columns}

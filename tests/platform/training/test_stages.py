"""Training in stages: who is trained where, and that the curve is reproducible."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learned import assert_equal
from numpy.typing import NDArray
from rehearsal import TOYS, FaultConfig, FaultyVisitors, collector_of, parameters_of, plan_of_toy
from runs import COPIES, STEPS, Backend, Log, job_of, logs_of, trained, with_algorithm

from headway.config.experiment import BackendConfig, StageConfig
from headway.contracts import Learner, Observations, Trajectory, child_seeds
from headway.events import CheckpointSaved, EvaluationFinished, IterationFinished
from headway.rollout.backends import open_collector
from headway.rollout.collector import Collector
from headway.rollout.plan import RolloutPlan
from headway.training.loop import TrainingJob
from headway_algos.off_policy.transitions import TransitionBuilder, Transitions
from headway_algos.registry import ENTRIES
from headway_algos.replay_config import MADQNConfig, NetworkConfig
from headway_envs.toy.visitors import VisitorsConfig

SHORT = VisitorsConfig(agents=3, steps=4)
"""Like the toy `visitors`, with shorter episodes: of 2 to 4 steps instead of 6 to 12."""


def _in_stages(job: TrainingJob, *lengths: int, later: Any = SHORT) -> TrainingJob:  # noqa: ANN401 - a config
    """Return a job with stages of so many iterations, all but the first on `later`."""
    stages = tuple(StageConfig(length * COPIES * STEPS) for length in lengths)
    plans = [replace(job.plan, training_prepared=later, stage=stage) for stage in range(1, len(lengths))]
    config = replace(job.config, stages=stages, env_steps=sum(lengths) * COPIES * STEPS)
    return replace(job, config=config, later_plans=tuple(plans))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Log:
    job = _in_stages(job_of(tmp_path_factory.mktemp("whole"), checkpoint_every=4), 3, 2, 1)
    events = trained(job)
    saved = [event.iteration for event in events if isinstance(event, CheckpointSaved)]
    assert saved == [3, 4, 5, 6], "at the end of each stage, besides every fourth iteration"
    evaluated = {e.env_steps // (COPIES * STEPS) for e in events if isinstance(e, EvaluationFinished)}
    assert evaluated == {0, 2, 3, 4, 5, 6}
    return logs_of(job)[0]


def test_each_stage_trains_in_its_environment_and_evaluation_stays(whole: Log) -> None:
    lengths: dict[bool, set[int]] = {False: set(), True: set()}
    for row in whole["episodes"]:
        lengths[int(row["iteration"]) > 3].add(int(row["length"]))
    assert max(lengths[True]) <= SHORT.steps < min(lengths[False])
    assert min(int(row["length"]) for row in whole["evaluation"]) > SHORT.steps


def test_one_learner_trains_through_all_stages(tmp_path: Path) -> None:
    """Its parameters are those with which the stage before ended."""
    made, seen = [], []

    def spied(*arguments: Any) -> Learner:  # noqa: ANN401 - a learner's
        learner = job.make_learner(*arguments)
        update = learner.update

        def noted(*parts: Any) -> dict[str, NDArray[np.float64]]:  # noqa: ANN401 - an update's
            seen.append({name: array.copy() for name, array in learner.acting_parameters().items()})
            metrics = update(*parts)
            seen.append({name: array.copy() for name, array in learner.acting_parameters().items()})
            return metrics

        learner.update = noted  # type: ignore[method-assign]
        made.append(learner)
        return learner

    job = _in_stages(job_of(tmp_path), 1, 1, 1)
    trained(replace(job, make_learner=spied))
    assert len(made) == 1
    for ended, began in ((seen[1], seen[2]), (seen[3], seen[4])):
        assert_equal(began, ended)


def test_until_the_first_stage_ends_the_curve_is_that_without_stages(whole: Log, tmp_path: Path) -> None:
    job = job_of(tmp_path, checkpoint_every=4)
    trained(job)
    plain = {row["iteration"]: row for row in logs_of(job)[0]["curve"]}
    staged = {row["iteration"]: row for row in whole["curve"]}
    assert staged["0"] == plain["0"]
    assert staged["1"] == plain["1"]
    assert staged["2"] == plain["2"]
    # Where the stage ends there is an evaluation too.
    assert {**staged["3"], **plain["3"]} == staged["3"]
    assert any(key.startswith("evaluation_") for key in staged["3"].keys() - plain["3"].keys())
    assert staged["4"].keys() == plain["4"].keys()
    assert staged["4"]["policy/entropy"] != plain["4"]["policy/entropy"]


def test_first_episodes_of_a_stage_have_seeds_of_their_own() -> None:
    plan = replace(plan_of_toy("visitors"), stage=2)
    make, config = TOYS["visitors"]
    with collector_of(plan, "serial") as collector, closing(make(config, plan.copies)) as env:
        collector.begin()
        collector.collect(1, parameters_of(plan))
        first: Observations = env.reset(child_seeds(plan.seeds[0], "env stage 2", 0, plan.copies))
        alive = first.alive.copy()
        np.testing.assert_array_equal(collector.trajectory.alive[0], alive)
        np.testing.assert_array_equal(collector.trajectory.observations[0][alive], first.observations[alive])
        others = env.reset(child_seeds(plan.seeds[0], "env", 0, plan.copies))
        assert not np.array_equal(others.alive, alive)


@pytest.mark.parametrize("stop", [None, 2])
def test_no_transition_reaches_from_one_stage_into_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int | None
) -> None:
    """Decisions that an iteration leaves open continue in the next one of the same stage only."""
    carried: list[bool] = []
    transitions = TransitionBuilder.transitions

    def noted(builder: TransitionBuilder, trajectory: Trajectory) -> Transitions:
        found = transitions(builder, trajectory)
        decided = trajectory.observations[:-1][trajectory.alive[:-1] & trajectory.acting]
        own = {row.tobytes() for row in decided}
        carried.append(any(row.tobytes() not in own for row in found.observations))
        return found

    monkeypatch.setattr(TransitionBuilder, "transitions", noted)
    config = MADQNConfig(model=NetworkConfig((4,)), learning_starts=1, batch_size=1, updates=1)
    job = with_algorithm(job_of(tmp_path, env=TOYS["visitors"]), ENTRIES["madqn"], config)
    job = _in_stages(job, 2, 2)
    trained(job, stop_after=stop)
    if stop is not None:
        trained(replace(job, resume=True))
    assert carried == [False, True, False, True]


@pytest.mark.parametrize("stop", [1, 3, 4, 5])
def test_a_run_resumed_in_any_stage_ends_with_the_same_curve(whole: Log, tmp_path: Path, stop: int) -> None:
    job = _in_stages(job_of(tmp_path, checkpoint_every=4), 3, 2, 1)
    trained(job, stop_after=stop)
    trained(replace(job, resume=True))
    assert logs_of(job) == [whole]


@pytest.mark.parametrize(("stop", "expected"), [(1, [0, 1, 2]), (3, [1, 2]), (4, [1, 2]), (5, [2])])
def test_a_resumed_run_starts_no_workers_of_earlier_stages(
    stop: int, expected: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[int] = []

    def noted(backend: BackendConfig, plan: RolloutPlan, *others: Any) -> Collector:  # noqa: ANN401
        opened.append(plan.stage)
        return open_collector(backend, plan, *others)

    job = _in_stages(job_of(tmp_path, checkpoint_every=4), 3, 2, 1)
    trained(job, stop_after=stop)
    monkeypatch.setattr("headway.training.loop.open_collector", noted)
    trained(replace(job, resume=True))
    assert opened == expected


@pytest.mark.parametrize("backend", ["serial", "process"])
def test_workers_and_other_seeds_change_nothing(backend: Backend, whole: Log, tmp_path: Path) -> None:
    job = _in_stages(job_of(tmp_path, seeds=(4, 5), backend=backend, checkpoint_every=4), 3, 2, 1)
    for events in (trained(job, stop_after=3), trained(replace(job, resume=True))):
        spent = [event.usage.cpu_seconds for event in events if isinstance(event, IterationFinished)]
        assert spent == sorted(spent), "time of workers that have ended still counts"
    assert logs_of(job)[1] == whole


def test_a_stage_without_snapshots_begins_anew_when_resumed(tmp_path: Path) -> None:
    """At the beginning of a stage this is exact, since no episode has begun; within it, a notice says so."""
    never = FaultConfig("kill", str(tmp_path), at=10**9, copies=99, snapshots=False)
    env = FaultyVisitors, never
    logs = []
    for name, stop in (("whole", None), ("halves", 3)):
        job = _in_stages(job_of(tmp_path / name, env=env, checkpoint_every=4), 3, 3, later=never)
        trained(job, stop_after=stop)
        if stop is not None:
            trained(replace(job, resume=True))
        logs.append(logs_of(job))
    assert logs[0] == logs[1]

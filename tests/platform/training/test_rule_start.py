"""Training that begins with a rule: who acts, what is learned, and that the curve is reproducible."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rehearsal import TOYS, collector_of, parameters_of, plan_of_toy
from runs import COPIES, STEPS, Backend, Log, job_of, logs_of, trained, with_algorithm

from headway.contracts import HeadwayError, Rule, child_seeds
from headway.events import EvaluationFinished
from headway.rollout.plan import RolloutPlan
from headway.training.loop import TrainingJob
from headway_algos.registry import ENTRIES
from headway_envs.toy.tracking import OptimalTracking
from headway_envs.toy.visitors import OptimalVisitors

RULES: dict[str, type[Rule]] = {"visitors": OptimalVisitors, "tracking": OptimalTracking}


def _plan(toy: str, rule_iterations: int) -> RolloutPlan:
    return replace(plan_of_toy(toy), rule=RULES[toy](TOYS[toy][1]), rule_iterations=rule_iterations)


@pytest.mark.parametrize("toy", RULES)
def test_the_rule_acts_in_the_first_iterations_only(toy: str) -> None:
    """Rewards are those of playing the rule on the same episodes, in the environment's own units."""
    plan = _plan(toy, rule_iterations=2)
    make, config = TOYS[toy]
    rule = RULES[toy](config)
    with collector_of(plan, "serial") as collector, closing(make(config, plan.copies)) as env:
        collector.begin()
        observed = env.reset(child_seeds(plan.seeds[0], "env", 0, plan.copies))
        for iteration in (1, 2, 3):
            collector.collect(iteration, parameters_of(plan))
            expected = []
            for _ in range(plan.steps):
                outcome, observed = env.step(rule.act(env, observed))
                expected.append(outcome.rewards.copy())
            same = np.allclose(collector.trajectory.rewards, expected, rtol=1e-4, atol=1e-5)
            assert same == (iteration < 3)


def _job(folder: Path, backend: Backend = "serial", seeds: tuple[int, ...] = (5,)) -> TrainingJob:
    """Return six iterations on visitors, of which the first three are the rule's."""
    job = job_of(folder, seeds=seeds, backend=backend)
    plan = replace(job.plan, rule=OptimalVisitors(TOYS["visitors"][1]), rule_iterations=3)
    return replace(job, plan=plan)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Log:
    job = _job(tmp_path_factory.mktemp("whole"))
    events = trained(job)
    evaluated = {event.env_steps for event in events if isinstance(event, EvaluationFinished)}
    # Every other iteration, and where the rule's end.
    assert evaluated == {COPIES * STEPS * i for i in (0, 2, 3, 4, 6)}
    return logs_of(job)[0]


@pytest.mark.parametrize("stop", [2, 4])
def test_a_run_that_is_resumed_ends_with_the_same_curve(whole: Log, tmp_path: Path, stop: int) -> None:
    job = _job(tmp_path)
    trained(job, stop_after=stop)
    trained(replace(job, resume=True))
    assert logs_of(job) == [whole]


@pytest.mark.parametrize("shared_until", [0.0, 0.75])
def test_a_stack_of_seeds_is_resumed_in_the_rules_iterations(shared_until: float, tmp_path: Path) -> None:
    """Each seed's decisions so far are stored once for the stack; also those of a policy to be split."""
    jobs = []
    for name in ("whole", "halves"):
        job = _job(tmp_path / name, seeds=(4, 5))
        config = replace(job.algo_config, policies="independent", shared_until=shared_until)
        jobs.append(with_algorithm(job, ENTRIES["ippo"], config))
    whole, halves = jobs
    trained(whole)
    trained(halves, stop_after=2)
    assert list(halves.checkpoints[0].glob("experience-*"))
    trained(replace(halves, resume=True))
    assert logs_of(halves) == logs_of(whole)


def test_workers_and_other_seeds_change_nothing(whole: Log, tmp_path: Path) -> None:
    job = _job(tmp_path, "process", seeds=(4, 5))
    trained(job)
    assert logs_of(job)[1] == whole


def test_an_entry_that_promises_too_much_is_named(tmp_path: Path) -> None:
    class Unwilling:
        """A learner without the methods."""

        def acting_parameters(self) -> None: ...

    job = replace(_job(tmp_path), make_learner=lambda *arguments: Unwilling())
    with pytest.raises(HeadwayError, match=r"has starts=True, .* or leave out start"):
        trained(job)

"""Training that begins with a rule: who acts, what is learned, and that the curve is reproducible."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rehearsal import TOYS, collector_of, parameters_of, plan_of_toy
from runs import COPIES, STEPS, Backend, Log, job_of, logs_of, trained, with_algorithm

from headway.config.experiment import StartConfig
from headway.contracts import BatchedEnv, HeadwayError, Observations, Rule, child_seeds
from headway.events import EvaluationFinished
from headway.rollout.plan import RolloutPlan
from headway.training.loop import TrainingJob
from headway.training.modes import SynchronousMode
from headway_algos.registry import ENTRIES, configure
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


class _Far(OptimalTracking):
    """A hundred times the optimal actions."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        return 100 * super().act(env, observed)


def test_actions_beyond_the_bounds_are_learned_as_the_environment_clips_them() -> None:
    """The environment's bounds are -2 and 2, those of policies -1 and 1."""
    plan = replace(plan_of_toy("tracking"), rule=_Far(TOYS["tracking"][1]), rule_iterations=1)
    make, config = TOYS["tracking"]
    with collector_of(plan, "serial") as collector, closing(make(config, plan.copies)) as env:
        collector.begin()
        collector.collect(1, parameters_of(plan))
        observed = env.reset(child_seeds(plan.seeds[0], "env", 0, plan.copies))
        for actions, rewards in zip(collector.trajectory.actions, collector.trajectory.rewards, strict=True):
            given = _Far(config).act(env, observed)
            np.testing.assert_allclose(actions, given.clip(-2, 2) / 2, rtol=1e-5)
            outcome, observed = env.step(given)
            np.testing.assert_allclose(rewards, outcome.rewards, rtol=1e-4, atol=1e-5)


def _job(folder: Path, backend: Backend = "serial", seeds: tuple[int, ...] = (5,)) -> TrainingJob:
    """Return six iterations on visitors, of which the first three are the rule's."""
    job = job_of(folder, seeds=seeds, backend=backend)
    plan = replace(job.plan, rule=OptimalVisitors(TOYS["visitors"][1]), rule_iterations=3)
    start = StartConfig(rule="optimal", env_steps=3 * COPIES * STEPS)
    return replace(job, plan=plan, config=replace(job.config, start=start))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Log:
    job = _job(tmp_path_factory.mktemp("whole"))
    events = trained(job)
    evaluated = {event.env_steps for event in events if isinstance(event, EvaluationFinished)}
    # Every other iteration, and where the rule's end.
    assert evaluated == {COPIES * STEPS * i for i in (0, 2, 3, 4, 6)}
    return logs_of(job)[0]


class _Spy:
    """A learner that only notes what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[float, bool]] = []

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        return {}

    def imitate(self, *arguments: object) -> dict[str, NDArray[np.float64]]:
        return {}

    update = start_from = state_dict = load_state_dict = imitate

    def anchor(self, kl_coeff: float, critic_only: bool) -> None:
        self.told.append((kl_coeff, critic_only))


def test_the_penalty_falls_linearly_to_0_and_the_critic_learns_first() -> None:
    """Over what remains of the budget after the rule: four of six iterations."""
    plan, learner = _plan("visitors", rule_iterations=2), _Spy()
    start = StartConfig(rule="optimal", kl_coeff=8.0, critic_iterations=1)
    with collector_of(plan, "serial") as collector:
        collector.begin()
        parameters = parameters_of(plan)
        learner.acting_parameters = lambda: parameters
        mode = SynchronousMode(learner, collector, 2, start, 6)
        for iteration in range(1, 7):
            mode.iterate(iteration, (iteration - 1) / 6)
    told, expected = zip(*learner.told, strict=True), [(8, True), (6, False), (4, False), (2, False)]
    coefficients, critic_only = told
    assert coefficients == pytest.approx([each[0] for each in expected])
    assert critic_only == tuple(each[1] for each in expected)


@pytest.mark.parametrize("stop", [2, 3, 4, 5])
def test_a_run_that_stays_near_its_start_is_resumed_exactly(stop: int, tmp_path: Path) -> None:
    jobs = []
    for name in ("whole", "halves"):
        job = _job(tmp_path / name, seeds=(4, 5))
        start = StartConfig(rule="optimal", env_steps=3 * COPIES * STEPS, kl_coeff=2.0, critic_iterations=1)
        jobs.append(replace(job, config=replace(job.config, start=start)))
    whole, halves = jobs
    trained(whole)
    trained(halves, stop_after=stop)
    trained(replace(halves, resume=True))
    assert logs_of(halves) == logs_of(whole)
    last = logs_of(whole)[0]["curve"][-1]
    assert float.fromhex(last["policy/start_kl"]) > 0


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
    start = StartConfig(rule="optimal", env_steps=3 * COPIES * STEPS, critic_iterations=1)
    job = with_algorithm(job, ENTRIES["madqn"], configure("madqn"))
    line = "allows start.critic_iterations, but .*AnchoredLearner; .* or leave out start.critic_iterations$"
    with pytest.raises(HeadwayError, match=line):
        trained(replace(job, config=replace(job.config, start=start)))

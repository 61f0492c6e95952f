"""Whole episodes on given seeds: evaluation of policies and rules."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, HeadwayError, Observations, Rule, StepResult, child_seeds, generator
from headway.contracts.acting_policy import Parameters
from headway.events import Row
from headway.rollout.nan_check import NameCopy, check_finite
from headway.rollout.plan import EVALUATION_BLOCK, RolloutPlan, evaluation_block
from headway.rollout.policy_player import PolicyPlayer
from headway.rollout.sampler import Tally

Told = Callable[[int, int], None]
"""Called after each step of episodes played at once: with the step, and how many of them ended at it."""
_NOISE_STEPS = 256
MOST_STEPS = 1_000_000
"""Steps after which an episode is taken for one that never ends."""


@dataclass(frozen=True)
class EvaluationRequest:
    """Episodes first to first + count - 1 of the evaluation seeds, for every replica of a plan."""

    root: int
    """Root of the evaluation seeds."""
    first: int
    count: int
    greedy: bool

    @classmethod
    def split(
        cls, root: int, episodes: int, greedy: bool, block: int = EVALUATION_BLOCK
    ) -> list["EvaluationRequest"]:
        """Requests of one evaluation block each: the same pieces on every backend."""
        starts = range(0, episodes, block)
        return [cls(root, first, min(block, episodes - first), greedy) for first in starts]

    @property
    def seeds(self) -> NDArray[np.uint64]:
        """Seeds of its episodes, (count,)."""
        return evaluation_seeds(self.root, self.first, self.count)

    def name_copy(self, row: int) -> str:
        """What to call a row of a batch that holds these episodes, once or for every replica."""
        return f"evaluation episode {self.first + row % self.count}"


def evaluation_seeds(root: int, first: int, count: int) -> NDArray[np.uint64]:
    """Seeds of evaluation episodes, the same for every run, algorithm and rule."""
    return child_seeds(root, "evaluation", first, count)


def nobody_told(step: int, ended: int) -> None:
    """The `Told` of whoever need not know how far things are."""


def run_episodes(
    env: BatchedEnv,
    seeds: NDArray[np.uint64],
    act: Callable[[Observations, int], NDArray[Any]],
    name_copy: NameCopy,
    heed: Callable[[StepResult], None] = lambda outcome: None,
    told: Told = nobody_told,
) -> list[Row]:
    """Play the first episode of every copy; one row a copy. `act` is given what is observed and the step,
    `heed` what the step led to, `told` how far things are.

    Raises HeadwayError where the environment gives a NaN or an infinity, or an episode does not end.
    """
    observed = env.reset(seeds)
    check_finite(env.spec, None, observed, 0, name_copy)
    tally = Tally(env.num_copies, env.spec.metrics)
    rows: dict[int, Row] = {}
    step = 0
    while len(rows) < env.num_copies:
        if step == MOST_STEPS:
            copy = min(set(range(env.num_copies)) - rows.keys())
            raise HeadwayError(
                f"environment {env.spec.name}: {name_copy(copy)} has not ended in {step:,} steps; "
                "its episodes must end by themselves or be truncated"
            )
        outcome, observed = env.step(act(observed, step))
        step += 1
        check_finite(env.spec, outcome, observed, step, name_copy)
        heed(outcome)
        before = len(rows)
        for copy, row in tally.add(outcome):
            rows.setdefault(copy, row)
        told(step, len(rows) - before)
    return [rows[copy] for copy in range(env.num_copies)]


def evaluate_policy(
    plan: RolloutPlan,
    parameters: Parameters,
    request: EvaluationRequest,
    told: Told = nobody_told,
) -> list[list[Row]]:
    """Episodes of every replica: one list a replica, one row an episode, with its `episode_seed` index."""
    env = plan.make(request.count)
    acting = PolicyPlayer(plan, request.count, request.count)
    noise = None if request.greedy else _EvaluationNoise(plan, request)

    def act(observed: Observations, step: int) -> NDArray[Any]:
        return acting.act(parameters, observed, None if noise is None else noise.at(step))[0]

    with closing(env):
        seeds = np.tile(request.seeds, plan.replicas)
        rows = run_episodes(env, seeds, act, request.name_copy, acting.heed, told)
    labelled: list[Row] = [
        {"episode_seed": request.first + i % request.count, **row} for i, row in enumerate(rows)
    ]
    return [labelled[r * request.count : (r + 1) * request.count] for r in range(plan.replicas)]


class _EvaluationNoise:
    """Action noise of sampled evaluation, a stream for each (seed, episode)."""

    def __init__(self, plan: RolloutPlan, request: EvaluationRequest) -> None:
        episodes = range(request.first, request.first + request.count)
        self.policy = plan.policy
        self.generators = [generator(seed, "evaluation action", i) for seed in plan.seeds for i in episodes]
        self.drawn: NDArray[np.float64] | None = None

    def at(self, step: int) -> NDArray[np.float64]:
        if step % _NOISE_STEPS == 0:
            self.drawn = np.stack([self.policy.noise(g, _NOISE_STEPS) for g in self.generators], axis=1)
        assert self.drawn is not None
        noise: NDArray[np.float64] = self.drawn[step % _NOISE_STEPS]
        return noise


def evaluate_rule(
    make_env: Callable[[Any, int], BatchedEnv],
    make_rule: Callable[[Any], Rule],
    prepared: object,
    root: int,
    episodes: int,
    told: Told = nobody_told,
) -> list[Row]:
    """Episodes of a rule (an entry's `make`, and that of its rule) on the evaluation seeds, one row each."""
    rows: list[Row] = []
    rule = make_rule(prepared)  # one for all blocks: a rule that draws must not draw the same in each
    with closing(make_env(prepared, 1)) as env:
        block = evaluation_block(env.spec)
    for request in EvaluationRequest.split(root, episodes, True, block):
        env = make_env(prepared, request.count)
        act = _RuleActing(env, rule)
        with closing(env):
            played = run_episodes(env, request.seeds, act, request.name_copy, told=told)
        rows += [{"episode_seed": request.first + i, **row} for i, row in enumerate(played)]
    return rows


@dataclass(frozen=True)
class _RuleActing:
    env: BatchedEnv
    rule: Rule

    def __call__(self, observed: Observations, step: int) -> NDArray[Any]:
        return self.rule.act(self.env, observed)

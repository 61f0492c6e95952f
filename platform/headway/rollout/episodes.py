"""Evaluation of policies and rules: complete episodes on given seeds."""

import os
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    EnvSpec,
    HeadwayError,
    Observations,
    Rule,
    StepResult,
    child_seeds,
    generator,
)
from headway.contracts.acting_policy import Parameters
from headway.events import Row
from headway.rollout.forks import end_if_forked
from headway.rollout.nan_check import NameCopy, check_finite
from headway.rollout.plan import RolloutPlan, evaluation_block
from headway.rollout.policy_player import PolicyPlayer
from headway.rollout.sampler import Tally

OnStep = Callable[[int, int], None]
"""Callback after each step of a batch of episodes, given the step and the number of episodes it ended."""
_NOISE_STEPS = 256
MAX_STEPS = 1_000_000
"""Steps after which an episode counts as endless."""


@dataclass(frozen=True)
class EvaluationRequest:
    """Episodes first to first + count - 1 of the evaluation seeds, for every replica of a plan."""

    root: int
    """Root of the evaluation seeds."""
    first: int
    count: int
    greedy: bool

    @classmethod
    def split(cls, root: int, episodes: int, greedy: bool, spec: EnvSpec) -> list["EvaluationRequest"]:
        """Split an evaluation into requests of `evaluation_block` episodes, the same on every backend."""
        block = evaluation_block(spec)
        starts = range(0, episodes, block)
        return [cls(root, first, min(block, episodes - first), greedy) for first in starts]

    @property
    def seeds(self) -> NDArray[np.uint64]:
        """Seeds of the episodes, shape (count,)."""
        return evaluation_seeds(self.root, self.first, self.count)

    def name_copy(self, row: int) -> str:
        """Return the name, for messages, of a row of the batch that plays these episodes."""
        return f"evaluation episode {self.first + row % self.count}"


def evaluation_seeds(root: int, first: int, count: int) -> NDArray[np.uint64]:
    """Return the seeds of evaluation episodes, the same for every run, algorithm and rule."""
    return child_seeds(root, "evaluation", first, count)


def ignore_step(step: int, ended: int) -> None:
    """`OnStep` callback that does nothing."""


def run_episodes(
    env: BatchedEnv,
    seeds: NDArray[np.uint64],
    act: Callable[[Observations, int], NDArray[Any]],
    name_copy: NameCopy,
    on_outcome: Callable[[StepResult], None] = lambda outcome: None,
    on_step: OnStep = ignore_step,
) -> list[Row]:
    """Play the first episode of every copy; return one row per copy.

    `act` returns the actions for the current observations and step; `on_outcome` receives each step's
    result. Raises HeadwayError if the environment returns NaN or infinity, or if an episode does not end.
    """
    observed = env.reset(seeds)
    check_finite(env.spec, None, observed, 0, name_copy)
    tally = Tally(env.num_copies, env.spec.metrics)
    rows: dict[int, Row] = {}
    step, process_id = 0, os.getpid()
    while len(rows) < env.num_copies:
        if step == MAX_STEPS:
            copy = min(set(range(env.num_copies)) - rows.keys())
            raise HeadwayError(
                f"environment {env.spec.name}: {name_copy(copy)} has not ended in {step:,} steps; "
                "every episode must terminate or be truncated"
            )
        outcome, observed = env.step(act(observed, step))
        end_if_forked(process_id)
        step += 1
        check_finite(env.spec, outcome, observed, step, name_copy)
        on_outcome(outcome)
        before = len(rows)
        for copy, row in tally.add(outcome):
            rows.setdefault(copy, row)
        on_step(step, len(rows) - before)
    return [rows[copy] for copy in range(env.num_copies)]


def evaluate_policy(
    plan: RolloutPlan,
    parameters: Parameters,
    request: EvaluationRequest,
    on_step: OnStep = ignore_step,
) -> list[list[Row]]:
    """Play one request's episodes with a policy; return one list per replica, with one row per episode.

    The column `episode_seed` is the index of the episode's evaluation seed.
    """
    env = plan.make(request.count)
    player = PolicyPlayer(plan, request.count, request.count)
    noise = None if request.greedy else _EvaluationNoise(plan, request)

    def act(observed: Observations, step: int) -> NDArray[Any]:
        return player.act(parameters, observed, None if noise is None else noise.at(step))[0]

    with closing(env):
        seeds = np.tile(request.seeds, plan.replicas)
        rows = run_episodes(env, seeds, act, request.name_copy, player.reset_ended, on_step)
    labelled: list[Row] = [
        {"episode_seed": request.first + i % request.count, **row} for i, row in enumerate(rows)
    ]
    return [labelled[r * request.count : (r + 1) * request.count] for r in range(plan.replicas)]


class _EvaluationNoise:
    """Action noise of sampled evaluation, from one random stream per (seed, episode)."""

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
    on_step: OnStep = ignore_step,
) -> list[Row]:
    """Play a rule on the evaluation seeds; return one row per episode.

    `make_env` and `make_rule` are the `make` of the environment's entry and of the rule's entry.
    """
    rows: list[Row] = []
    rule = make_rule(prepared)  # one for all blocks, so that a random rule continues its random stream
    with closing(make_env(prepared, 1)) as env:
        requests = EvaluationRequest.split(root, episodes, True, env.spec)
    for request in requests:
        with closing(make_env(prepared, request.count)) as env:
            act = partial(_rule_actions, rule, env)
            played = run_episodes(env, request.seeds, act, request.name_copy, on_step=on_step)
        rows += [{"episode_seed": request.first + i, **row} for i, row in enumerate(played)]
    return rows


def _rule_actions(rule: Rule, env: BatchedEnv, observed: Observations, step: int) -> NDArray[Any]:
    return rule.act(env, observed)

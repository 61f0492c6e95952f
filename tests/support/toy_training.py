"""Training on small games in this process, and how near the result comes to their known optima."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from headway.config.experiment import StartConfig
from headway.contracts import AlgoEntry, AsynchronousLearner, BatchedEnv, Learner
from headway.events import Row
from headway.rollout.async_collector import SerialContributors
from headway.rollout.collector import Backend
from headway.rollout.episodes import evaluate_rule
from headway.rollout.plan import RolloutPlan
from headway.rollout.serial_collector import SerialCollector
from headway.training.modes import AsynchronousMode, Mode, SynchronousMode
from headway_algos.registry import ENTRIES, configure
from headway_envs.toy.entry import ENTRIES as TOYS

ROOT, EPISODES = 77, 20
"""Evaluation seeds, the same for learners and rules."""


def opened(
    plan: RolloutPlan, entry: AlgoEntry, config: object, device: str = "cpu"
) -> tuple[Learner, Backend, Mode]:
    """Return a learner, its workers in this process, and how they train."""
    learner = entry.learner(config, plan.spec, plan.seeds, device)
    if entry.contributor is None:
        collector = SerialCollector(plan)
        return learner, collector, SynchronousMode(learner, collector, 0, StartConfig(), iterations=1000)
    assert isinstance(learner, AsynchronousLearner)
    make_contributor = partial(entry.contributor, config, plan.spec, plan.seeds)
    contributors = SerialContributors(replace(plan, make_contributor=make_contributor))
    return learner, contributors, AsynchronousMode(learner, contributors, iterations=1000)


def train(
    make_env: Callable[[Any, int], BatchedEnv],
    prepared: object,
    algorithm: str,
    settings: Mapping[str, Any],
    batch: tuple[int, int, int],
    seed: int = 0,
) -> list[Row]:
    """Return greedy evaluation episodes after training on `batch` = copies, steps, iterations.

    Asynchronous algorithms have four workers that take turns, so that gradients are stale by three updates.
    """
    copies, steps, iterations = batch
    entry, seeds, config = ENTRIES[algorithm], (seed,), configure(algorithm, **settings)
    spec = make_env(prepared, 1).spec.for_policies
    policy = entry.acting_policy(config, spec)
    block = copies if entry.contributor is None else copies // 4
    plan = RolloutPlan(make_env, (), prepared, spec, policy, seeds, copies, steps, block)
    learner, collector, mode = opened(plan, entry, config)
    collector.begin()
    for iteration in range(1, iterations + 1):
        done = mode.iterate(iteration, (iteration - 1) / iterations)
    assert entry.contributor is None or done.metrics["staleness/mean"][0] == 3
    [evaluated] = collector.evaluate(ROOT, EPISODES, True, learner.acting_parameters())
    collector.close()
    return evaluated


def train_toy(
    env: str,
    env_args: Mapping[str, Any],
    algorithm: str,
    settings: Mapping[str, Any],
    batch: tuple[int, int, int],
    seed: int = 0,
) -> list[Row]:
    """`train` on a toy environment."""
    toy = TOYS[env]
    return train(toy.make, toy.prepare(toy.config(**env_args)), algorithm, settings, batch, seed)


def mean_return(rows: list[Row]) -> float:
    """Return the mean over episodes."""
    return float(np.mean([float(row["return"]) for row in rows]))


def return_of_rule(env: str, env_args: Mapping[str, Any], name: str) -> float:
    """Return the mean return of a rule."""
    toy = TOYS[env]
    prepared = toy.prepare(toy.config(**env_args))
    return mean_return(evaluate_rule(toy.make, toy.rules[name].make, prepared, ROOT, EPISODES))


def share_of_optimum(env: str, env_args: Mapping[str, Any], evaluated: list[Row]) -> float:
    """Return how far the mean return lies on the way from random to optimal play."""
    random, best = (return_of_rule(env, env_args, name) for name in ("random", "optimal"))
    return (mean_return(evaluated) - random) / (best - random)

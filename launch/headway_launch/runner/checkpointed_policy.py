"""Policies from checkpoints, and the days that they play."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.events import Row
from headway.rollout.episodes import EvaluationRequest, OnStep, evaluate_policy, ignore_step
from headway.rollout.plan import RolloutPlan, evaluation_block
from headway.store.checkpoint import load_latest
from headway.store.checkpoint_fit import require_fitting
from headway.store.run_folder import CHECKPOINTS
from headway_launch.experiments.compose import PreparedEnv
from headway_launch.runner.stored_run import StoredRun


@dataclass(frozen=True)
class TrainedPolicy:
    """The policies of one seed, and how they are played."""

    plan: RolloutPlan
    """Of this seed alone."""
    parameters: Mapping[str, NDArray[Any]]
    """Leading axis K: the policies of one replica."""
    iteration: int


def newest_policy(run: StoredRun, environment: PreparedEnv) -> TrainedPolicy:
    """The policies in the newest whole checkpoint of a run, to be played in an environment: its own, or one
    that is reported on alike. Raises HeadwayError if it has none, or was made where agents observed
    otherwise."""
    iteration, state, notices = load_latest(run.directory / CHECKPOINTS)
    for line in notices:
        print(f"headway: {line}", file=sys.stderr)
    experiment, rollout = run.experiment, run.experiment.config.rollout
    policy = experiment.algo.acting_policy(experiment.algo_config, environment.spec)
    env, seeds, replicas = environment.entry, (run.record.seed,), len(run.stack)
    require_fitting(state["acting"], policy, replicas, experiment.config.env.id, run.directory)
    plan = RolloutPlan.of(
        rollout, env.make, env.preload, environment.prepared, environment.spec, policy, seeds
    )
    replica = run.stack.index(run.record.seed)
    parameters = {name: np.split(np.asarray(a), replicas)[replica] for name, a in state["acting"].items()}
    return TrainedPolicy(plan, parameters, iteration)


def policy_episodes(
    policy: TrainedPolicy,
    root: int,
    episodes: int,
    greedy: bool,
    told: OnStep = ignore_step,
) -> list[Row]:
    """One row an episode on the evaluation seeds that follow from `root`."""
    rows: list[Row] = []
    for request in EvaluationRequest.split(root, episodes, greedy, evaluation_block(policy.plan.spec)):
        rows += evaluate_policy(policy.plan, policy.parameters, request, told)[0]
    return rows

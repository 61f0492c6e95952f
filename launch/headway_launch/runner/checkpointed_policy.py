"""Trained policies loaded from checkpoints, and the episodes that they play."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.rollout.episodes import EvaluationRequest, OnStep, evaluate_policy, ignore_step
from headway.rollout.plan import RolloutPlan
from headway.store.checkpoint import load_latest, require_same_shapes
from headway.store.run_folder import CHECKPOINTS
from headway_launch.console.output import prints_to_stderr
from headway_launch.experiments.compose import PreparedEnv
from headway_launch.runner.stored_run import StoredRun


@dataclass(frozen=True)
class TrainedPolicy:
    """The trained policies of one seed, with the plan for playing them."""

    plan: RolloutPlan
    """Rollout plan of this seed only."""
    parameters: Mapping[str, NDArray[Any]]
    """Actor parameters by name; leading axis: the K policies of one replica."""
    iteration: int


def newest_policy(run: StoredRun, environment: PreparedEnv) -> TrainedPolicy:
    """Return the policies in the newest complete checkpoint of a run, for playing in `environment`.

    `environment` is the run's own, or one with the same `Experiment.evaluated_env`. Raises HeadwayError if
    there is no checkpoint, or if it does not fit the environment's observations and actions or is not finite.
    """
    iteration, state, notices = load_latest(run.directory / CHECKPOINTS)
    for line in notices:
        print(f"headway: {line}", file=sys.stderr)
    experiment, rollout = run.experiment, run.experiment.config.rollout
    spec = run.policy_spec(environment)
    policy = experiment.algo.acting_policy(experiment.algo_config, spec)
    env, seeds, replicas = environment.entry, (run.record.seed,), len(run.stack)
    require_same_shapes(state["acting"], policy, replicas, experiment.config.env.id, run.directory)
    plan = RolloutPlan.of(rollout, env.make, env.preload, environment.prepared, spec, policy, seeds)
    replica = run.stack.index(run.record.seed)
    parameters = {name: np.split(np.asarray(a), replicas)[replica] for name, a in state["acting"].items()}
    for name, array in parameters.items():
        if not np.isfinite(array).all():
            raise HeadwayError(f"run {run.directory.name} diverged: its policy's {name} is not finite")
    return TrainedPolicy(plan, parameters, iteration)


@prints_to_stderr()
def policy_episodes(
    policy: TrainedPolicy,
    root: int,
    episodes: int,
    greedy: bool,
    told: OnStep = ignore_step,
) -> list[Row]:
    """Play `episodes` episodes on the evaluation seeds derived from `root`; return one row per episode."""
    rows: list[Row] = []
    for request in EvaluationRequest.split(root, episodes, greedy, policy.plan.spec):
        rows += evaluate_policy(policy.plan, policy.parameters, request, told)[0]
    return rows

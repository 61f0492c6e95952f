"""Trained policies loaded from checkpoints, and the episodes that they play."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.rollout.episodes import EvaluationRequest, OnStep, evaluate_policy, ignore_step
from headway.rollout.plan import RolloutPlan
from headway.store.checkpoint import UnfitPolicyError, stored_parameters
from headway_launch.console.output import prints_to_stderr
from headway_launch.experiments.experiment import PreparedEnv
from headway_launch.runner.stored_run import StoredRun


@dataclass(frozen=True)
class TrainedPolicy:
    """The trained policies of one seed, with the plan for playing them."""

    plan: RolloutPlan
    """Rollout plan of this seed only."""
    parameters: Mapping[str, NDArray[Any]]
    """Actor parameters by name; leading axis: the K policies of one replica."""
    iteration: int


def stored_policy(
    run: StoredRun, environment: PreparedEnv, best: bool = False, changed: Sequence[str] = ()
) -> TrainedPolicy:
    """Return the policies in the newest complete checkpoint of a run, for playing in `environment`.

    `environment` is the run's own, one with the same `Experiment.evaluated_env`, or one `changed` by
    `env.args.KEY=VALUE`. `best`: the policies at the evaluation with the highest return instead of the
    newest. Raises HeadwayError if there is no checkpoint, or if it does not fit the environment's
    observations and actions or is not finite.
    """
    experiment, rollout = run.experiment, run.experiment.config.rollout
    spec = environment.spec.for_policies
    policy = experiment.algo.acting_policy(experiment.algo_config, spec)
    env, seed = environment.entry, run.record.seed
    try:
        iteration, parameters, notices = stored_parameters(
            run.directory, policy, seed, run.plan.stack, experiment.config.env.id, best
        )
    except UnfitPolicyError as error:
        if not changed:
            raise
        raise HeadwayError(
            f"with {', '.join(changed)}, observations, actions or agents have other shapes than those that "
            f"run {run.record.run_id} was trained on; change other arguments, or train with these"
        ) from error
    for line in notices:
        print(f"headway: {line}", file=sys.stderr)
    plan = RolloutPlan(
        env.make, env.preload, environment.prepared, spec, policy, (seed,), rollout.copies, rollout.steps,
        rollout.block,
    )  # fmt: skip
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

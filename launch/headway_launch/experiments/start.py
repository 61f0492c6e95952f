"""What training starts from instead of random parameters: a rule of the environment, or another run."""

from dataclasses import fields
from pathlib import Path

import numpy as np

from headway.config.schema import plain
from headway.contracts.acting_policy import ActingPolicy
from headway.contracts.entries import Rule
from headway.contracts.errors import HeadwayError
from headway.registry import rule_entry
from headway.store.run_configuration import read_configuration
from headway.store.run_folder import CHECKPOINTS, RunRecord, find_run
from headway.store.run_plan import RunPlan
from headway.training.loop import ParentRun
from headway_launch.experiments.compose import require_rule
from headway_launch.experiments.experiment import Experiment, PreparedEnv
from headway_launch.experiments.override_words import written
from headway_launch.experiments.parameters import flat

_MEANINGS = ("model.activation", "normalise_observations", "normalise_rewards")
"""Keys of `algo` that change the meaning of networks taken over, but not the shapes of their parameters."""
_OF_CRITICS = ("critic", "normalise_values")
"""Keys of `algo` that do so for critics of on-policy algorithms only."""


def start_rule(experiment: Experiment, environment: PreparedEnv) -> Rule | None:
    """Return the rule `start.rule` for the training environment; None if there is none.

    Raises HeadwayError if the environment has no such rule, if it or the algorithm cannot be used, or if
    there is none and a key that applies to a rule is set.
    """
    name, env_id = experiment.config.start.rule, experiment.config.env.id
    if name is None:
        config, key = experiment.algo_config, "imitation_entropy_coeff"
        if getattr(config, key, None) != getattr(type(config), key, None):
            raise HeadwayError(f"algo.{key} applies to a rule: set start.rule too, or leave this out")
        return None
    require_rule(name, env_id, experiment.training_env)
    _require_start(experiment, "start.rule")
    try:
        return rule_entry(experiment.training_env, name).make(environment.training)
    except HeadwayError as error:  # wrappers hide its inputs
        raise HeadwayError(f"start.rule: {error}") from error


def parent_run(experiment: Experiment, policy: ActingPolicy) -> ParentRun | None:
    """Return the run `start.run`, whose policies must have the shapes of `policy`; None if there is none.

    Raises HeadwayError if there is no such run, or if its policies or the algorithm cannot be used.
    """
    config = experiment.config
    if config.start.run is None:
        return None
    _require_start(experiment, "start.run")
    if getattr(experiment.algo_config, "splits", False):
        raise HeadwayError(
            "start.run takes over separate policies, and algo.shared_until begins with a shared one; leave "
            "one of them out"
        )
    folder = find_run(Path(config.store.root), config.start.run).resolve()
    record, plan = RunRecord.read(folder), RunPlan.read(folder)
    if record.settled_status == "RUNNING":
        raise HeadwayError(f"start.run: {folder.name} is still training; start from it when it has ended")
    theirs, own = read_configuration(folder).get("algo", {}), plain(experiment.algo_config)
    _require_fitting(folder, record, plan, policy)
    for key in _MEANINGS:
        there, here = dict(flat(theirs)).get(key), dict(flat(own)).get(key)
        if there != here:
            raise HeadwayError(
                f"start.run: {folder.name} was trained with algo.{key}={there}, and this experiment has "
                f"{here}; set algo.{key}={there}"
            )
    alike = all(theirs.get(key) == own.get(key) for key in _OF_CRITICS)
    same = record.algorithm == experiment.algo_name and alike
    return ParentRun(str(folder), plan.stack.index(record.seed), len(plan.stack), with_critic=same)


def _require_start(experiment: Experiment, key: str) -> None:
    start = experiment.config.start
    if not experiment.algo.starts or experiment.algo.contributor is not None:
        given = [part for part in fields(start) if getattr(start, part.name) != part.default]
        without = " ".join(f"start.{part.name}={written(part.default)}" for part in given)
        raise HeadwayError(
            f"{key}: {experiment.algo_name} starts from random parameters only; add {without}, or use "
            "another algorithm, such as algo=ippo"
        )
    if start.anchors:
        of = experiment.algo_config, start.kl_coeff, start.critic_iterations
        if line := experiment.algo.refuses_anchor(*of):
            raise HeadwayError(f"{experiment.algo_name}: {line}")


def _require_fitting(folder: Path, record: RunRecord, plan: RunPlan, policy: ActingPolicy) -> None:
    """Raise HeadwayError unless the policies in a run's newest checkpoint have the kind and shapes of
    `policy`."""
    from headway.store.checkpoint import load_latest

    _, state, _ = load_latest(folder / CHECKPOINTS)
    shapes = {name: np.shape(array) for name, array in state["acting"].items()}
    stored = {name: (of[0] // len(plan.stack), *of[1:]) for name, of in shapes.items() if of}
    expected = {name: shape for name, (shape, _) in policy.parameter_shapes(1).items()}
    if stored.keys() != expected.keys():
        part = min(stored.keys() ^ expected.keys())
        raise HeadwayError(
            f"start.run: the policies of {folder.name}, a run of {record.algorithm}, are of another kind "
            f"(only {'theirs' if part in stored else 'those here'} have {part}); start from a run of the "
            "same family of algorithms, with the same kind of actions and algo.model"
        )
    learner = state.get("learner")
    if isinstance(learner, dict) and learner.get("parted") is False:
        raise HeadwayError(
            f"start.run: {folder.name} ended before its shared policy was split (algo.shared_until); resume "
            "it first"
        )
    if stored == expected:
        return
    name = min(name for name in expected if stored[name] != expected[name])
    raise HeadwayError(
        f"start.run: the policies of {folder.name} have another shape ({name} is {stored[name]} there and "
        f"{expected[name]} here); start from a run with the same observations, actions, algo.model, "
        "algo.policies and algo.agent_id"
    )

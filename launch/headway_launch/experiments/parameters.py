"""An experiment as nested mappings and flat parameters, as stored, and the keys that identify runs."""

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from headway.config.experiment import ExperimentConfig
from headway.config.schema import plain

if TYPE_CHECKING:
    from headway_launch.experiments.experiment import Experiment

_IDENTITY_KEYS = ("study", "env_steps", "device", "env", "algo", "rollout", "evaluation")


def session_settings(config: ExperimentConfig) -> dict[str, object]:
    """Return the settings, by key, that are the same for all experiments of a session.

    Experiments that differ in one of them need separate sessions.
    """
    return {
        "study": config.study,
        "store": config.store,
        "energy": config.energy,
        "backend.parallel": config.backend.parallel,
        "backend.address": config.backend.address,
        "backend.learners": config.backend.learners,
    }


def full_mapping(experiment: "Experiment", seeds: Sequence[int]) -> dict[str, Any]:
    """Return the configuration with every default written out, so that stored runs keep old defaults."""
    config: ExperimentConfig = experiment.config
    evaluation = {**plain(config.evaluation), "rules": list(experiment.rules)}
    return {
        **plain(config),
        "evaluation": evaluation,
        "seed": list(seeds),
        "env": {
            "id": config.env.id,
            "args": plain(experiment.env_config),
            "training_args": plain(config.env.training_args or {}),
            **experiment.env_mapping,
        },
        "algo": {**plain(experiment.algo_config), "name": experiment.algo_name},
    }


def cell_parameters(experiment: "Experiment") -> dict[str, Any]:
    """Return the parameters that all runs of a cell share, by dotted name."""
    whole = full_mapping(experiment, ())
    kept = {key: whole[key] for key in ("env_steps", "device", "env", "algo", "rollout")}
    return dict(flat({**kept, **_start_and_stages(whole)}))


def _start_and_stages(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """Return `start` and `stages`, each only if a run has one: earlier versions stored neither."""
    found = {"start": _start(mapping.get("start") or {}), "stages": mapping.get("stages")}
    return {key: value for key, value in found.items() if value}


def _start(start: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a run starts from, without keys that have no effect; empty for random parameters."""
    anchored = {key: start[key] for key in ("kl_coeff", "critic_iterations") if start.get(key)}
    if start.get("rule"):
        return {key: start[key] for key in ("rule", "env_steps")} | anchored
    return {"run": start["run"]} | anchored if start.get("run") else {}


def flat(mapping: Mapping[str, Any], path: str = "", with_empty: bool = False) -> list[tuple[str, Any]]:
    """Return nested mappings as (dotted name, value) pairs; `with_empty`: keep empty mappings as values."""
    items: list[tuple[str, Any]] = []
    for key, value in mapping.items():
        if isinstance(value, Mapping) and (value or not with_empty):
            items += flat(value, f"{path}{key}.", with_empty)
        else:
            items.append((f"{path}{key}", value))
    return items


def identity(mapping: Mapping[str, Any]) -> str:
    """Return a key that is equal for two runs of a seed if they have the same study and learning curve.

    The number of processes, the store, the rules evaluated and energy measurement are left out.
    """
    kept = {**{name: mapping.get(name) for name in _IDENTITY_KEYS}, **_start_and_stages(mapping)}
    evaluation = mapping.get("evaluation") or {}
    kept["evaluation"] = {name: value for name, value in evaluation.items() if name != "rules"}
    stack = mapping.get("backend", {}).get("stack", 1)
    return json.dumps([kept, stack], sort_keys=True, default=str)

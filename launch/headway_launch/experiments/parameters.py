"""An experiment as nested mappings and flat parameters: what is stored, and what tells cells apart."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from headway.config.experiment import ExperimentConfig
from headway.config.schema import plain
from headway_launch.experiments.compose import Experiment

_DECIDES = ("study", "env_steps", "device", "env", "algo", "rollout", "evaluation")


def session_settings(config: ExperimentConfig) -> dict[str, object]:
    """What a session has one of, by its key: experiments that differ here take a session each."""
    return {
        "study": config.study,
        "store": config.store,
        "energy": config.energy,
        "backend.parallel": config.backend.parallel,
        "backend.address": config.backend.address,
        "backend.learners": config.backend.learners,
    }


def full_mapping(experiment: Experiment, seeds: Sequence[int]) -> dict[str, Any]:
    """The whole configuration with every default spelt out, so that a changed default changes no old run."""
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


def cell_parameters(experiment: Experiment) -> dict[str, Any]:
    """What makes runs the same but for the seed: flat, dotted names."""
    whole = full_mapping(experiment, ())
    kept = {key: whole[key] for key in ("env_steps", "device", "env", "algo", "rollout")}
    return dict(flat(kept))


def flat(mapping: Mapping[str, Any], path: str = "", with_empty: bool = False) -> list[tuple[str, Any]]:
    """Nested mappings as (dotted name, value); `with_empty`, empty mappings are values, too."""
    items: list[tuple[str, Any]] = []
    for key, value in mapping.items():
        if isinstance(value, Mapping) and (value or not with_empty):
            items += flat(value, f"{path}{key}.", with_empty)
        else:
            items.append((f"{path}{key}", value))
    return items


def identity(mapping: Mapping[str, Any]) -> str:
    """What makes two runs of a seed the same run: the study and everything that decides their curves. How
    many processes train them, where they are kept, which rules play beside them and whether energy is
    measured decides nothing."""
    decides = {name: mapping.get(name) for name in _DECIDES}
    evaluation = mapping.get("evaluation") or {}
    decides["evaluation"] = {name: value for name, value in evaluation.items() if name != "rules"}
    stack = mapping.get("backend", {}).get("stack", 1)
    return json.dumps([decides, stack], sort_keys=True, default=str)

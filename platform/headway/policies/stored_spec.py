"""Action spaces and environment specifications as JSON values."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from math import inf, isinf
from typing import Any

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, MultiDiscrete, ObservationFeature


def space_json(space: ActionSpace) -> dict[str, Any]:
    """Return a space as JSON, such as `{"type": "Discrete", "n": 3}`; a bound that is infinite is null."""
    values = asdict(space)
    if isinstance(space, Box):
        values = {key: [None if isinf(x) else x for x in bounds] for key, bounds in values.items()}
    return {"type": type(space).__name__, **values}


def space_of(content: Mapping[str, Any]) -> ActionSpace:
    """Inverse of `space_json`. Raises KeyError, TypeError or ValueError if it is not such a mapping."""
    values = dict(content)
    name = values.pop("type")
    match name:
        case "Discrete":
            return Discrete(int(values["n"]))
        case "MultiDiscrete":
            return MultiDiscrete(tuple(int(n) for n in values["nvec"]))
        case "Box":
            low = tuple(-inf if x is None else float(x) for x in values["low"])
            return Box(low, tuple(inf if x is None else float(x) for x in values["high"]))
    raise ValueError(f"{name} is not an action space")


def spec_json(spec: EnvSpec) -> dict[str, Any]:
    """Return a specification as JSON."""
    return {**asdict(spec), "action_space": space_json(spec.action_space)}


def spec_of(content: Mapping[str, Any]) -> EnvSpec:
    """Inverse of `spec_json`. Raises KeyError, TypeError or ValueError if it is not such a mapping."""
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in content.items()
    }
    features = features_of(content["observation_features"])
    space = space_of(content["action_space"])
    return EnvSpec(**{**values, "action_space": space, "observation_features": features})


def features_of(content: Iterable[Mapping[str, Any]]) -> tuple[ObservationFeature, ...]:
    """Return features of observations from their JSON values. Raises TypeError if a value has other keys."""
    return tuple(ObservationFeature(**feature) for feature in content)

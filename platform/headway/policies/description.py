"""Description of a trained policy: all that is needed besides its arrays, with a form in JSON."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, ObservationFeature, PolicyNetwork
from headway.policies.stored_spec import features_of, space_json, space_of

Arrays = Mapping[str, NDArray[Any]]
_FORMAT = 1


@dataclass(frozen=True)
class PolicyDescription:
    """A trained policy without its arrays."""

    agents: tuple[str, ...]
    """Names of the N agents in array order."""
    observation_size: int
    """D: components of an observation."""
    action_space: ActionSpace
    """Action space of the environment."""
    has_action_mask: bool
    """Whether the policy needs action masks."""
    network: PolicyNetwork
    precision: str
    """Dtype of the network's arrays, inputs and hidden states: float32 or float64."""
    origin: Mapping[str, Any]
    """Where the policy is from, as JSON values: run, algorithm, environment, iteration, versions."""
    observation_features: tuple[ObservationFeature, ...] = ()
    """The D numbers of an observation in order; empty: the environment does not describe them."""
    normalisation: Mapping[str, Any] = field(default_factory=dict)
    """What the network does to observations first, clip((x - mean) * scale, -clip, clip): `mean` and `scale`,
    (D,) per policy, and `clip`, as JSON values. Empty: nothing."""

    @property
    def constants(self) -> dict[str, NDArray[Any]]:
        """Arrays that follow from the description, by name, for `headway.policies.network.evaluate`.

        `policy_of_agent` (N,); `indices` (N, 1, G), the one-hot inputs; for Box actions `action_scale` and
        `action_offset` (A,), from network outputs to environment actions, and the bounds `action_low` and
        `action_high` (A,).
        """
        network = self.network
        constants: dict[str, NDArray[Any]] = {}
        if network.num_indices:
            constants["indices"] = np.eye(network.num_indices)[list(network.index_of_agent)][:, None]
        if isinstance(self.action_space, Box):
            scale, offset = self.action_space.for_policies.scaling_to(self.action_space)
            low, high = np.array(self.action_space.low), np.array(self.action_space.high)
            if network.output == "tanh":
                scale, offset = (high - low) / 2, (high + low) / 2
            constants |= {"action_scale": scale, "action_offset": offset}
            constants |= {"action_low": low, "action_high": high}
        numbers = {name: array.astype(self.precision) for name, array in constants.items()}
        return {"policy_of_agent": np.array(network.policy_of_agent, np.int64), **numbers}

    def to_json(self) -> str:
        """Return the description as JSON text."""
        content = {**asdict(self), "action_space": space_json(self.action_space)}
        return json.dumps({"headway_policy": _FORMAT, **content}, default=str)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Inverse of `to_json`. Raises KeyError, TypeError or ValueError if it is not such a text."""
        content = json.loads(text)
        if content["headway_policy"] != _FORMAT:
            raise ValueError("it is from another version of Headway")
        network: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in content["network"].items()
        }
        description = cls(
            tuple(content["agents"]),
            int(content["observation_size"]),
            space_of(content["action_space"]),
            bool(content["has_action_mask"]),
            PolicyNetwork(**network),
            str(np.dtype(content["precision"])),
            dict(content["origin"]),
            features_of(content["observation_features"]),
            dict(content["normalisation"]),
        )
        description._check()
        return description

    def _check(self) -> None:
        """Raise ValueError unless the network's sizes and names are consistent with the agents."""
        network, agents = self.network, len(self.agents)
        fits = (
            0 < agents == len(set(self.agents)) == len(network.policy_of_agent),
            all(policy >= 0 for policy in network.policy_of_agent),
            len(network.index_of_agent) == (agents if network.num_indices else 0),
            all(0 <= index < network.num_indices for index in network.index_of_agent),
            network.activation in ("tanh", "relu"),
            network.output in (("logits", "values") if self.action_space.options else ("mean", "tanh")),
            network.hidden_layers >= 0 and network.hidden_size >= 0 and network.observation_clip >= 0,
            self.precision in ("float32", "float64"),
            len(self.observation_features) in (0, self.observation_size),
        )
        if not all(fits):
            raise ValueError("its agents and its network do not fit each other")

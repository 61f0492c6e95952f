"""Acting policy with gated recurrent units, in numpy."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import ActingPolicy, EnvSpec, Observations
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.live_agents import ActingResult, RecurrentActing
from headway_algos.acting.mlp import MLPActingPolicy, actor_outputs
from headway_algos.config import AlgoConfig


def acting_policy(config: AlgoConfig, spec: EnvSpec) -> ActingPolicy:
    """Return the acting policy of an on-policy algorithm, with or without recurrence."""
    flat = MLPActingPolicy.of(config, spec)
    return flat if config.model.core == "none" else GRUActingPolicy(flat, config.model.gru_size)


def gated_step(
    from_input: NDArray[Any], hidden_states: NDArray[Any], weight: NDArray[Any], bias: NDArray[Any]
) -> NDArray[Any]:
    """Return the next hidden states (P, M, B). Equations and other shapes: `headway_algos.networks.gru`."""
    size = hidden_states.shape[1]
    from_hidden = np.matmul(weight, hidden_states)
    # The logistic function by tanh, which does not overflow.
    gates = from_input[:, : 2 * size] + from_hidden[:, : 2 * size]
    gates *= 0.5
    np.tanh(gates, out=gates)
    gates += 1
    gates *= 0.5
    reset, update = gates[:, :size], gates[:, size:]
    candidate = from_hidden[:, 2 * size :] + bias
    candidate *= reset
    candidate += from_input[:, 2 * size :]
    np.tanh(candidate, out=candidate)
    return np.asarray(candidate + update * (hidden_states - candidate))


@dataclass(frozen=True)
class GRUActingPolicy(RecurrentActing):
    """P stacked policies with gated recurrent units between the hidden layers and the output layer.

    The hidden state of a live agent is updated at every step, whether or not its action is used.
    """

    flat: MLPActingPolicy
    """Normalisation, hidden layers, output layer and action distribution."""
    hidden_size: int
    """M: number of units."""

    @property
    def hidden_dtype(self) -> np.dtype[Any]:
        """Dtype of hidden states, the same as of parameters."""
        return np.dtype(self.flat.precision)

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return the shapes of the feedforward layers and of the recurrent units."""
        flat, size = self.flat, self.hidden_size
        stack = replicas * flat.grouping.num_policies
        input_size = flat.hidden[-1] if flat.hidden else flat.spec.observation_size
        shapes = {
            f"weight_{len(flat.hidden)}": (stack, actor_outputs(flat.spec), size),
            "gru_weight_input": (stack, 3 * size, input_size),
            "gru_weight_memory": (stack, 3 * size, size),
            "gru_bias_input": (stack, 3 * size, 1),
            "gru_bias_memory": (stack, size, 1),
        }
        return flat.parameter_shapes(replicas) | {name: (s, self.hidden_dtype) for name, s in shapes.items()}

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Return the same random numbers as `MLPActingPolicy.noise`."""
        return self.flat.noise(generator, steps)

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Act from hidden states of 0."""
        hidden_states = np.zeros((*observed.alive.shape, self.hidden_size), self.hidden_dtype)
        return self.act_from(parameters, observed, hidden_states, noise)[:2]

    @cached_property
    def single_agent(self) -> Self | None:
        """The same policy for one agent that is always alive (see `MaskedActingPolicy`)."""
        return None if self.flat.single_agent is None else replace(self, flat=self.flat.single_agent)

    def replicas(self, parameters: Parameters) -> int:
        """Return R, the number of replicas in `parameters`."""
        return self.flat.replicas(parameters)

    def act_on_all_slots(
        self,
        parameters: Parameters,
        observed: Observations,
        hidden_states: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> ActingResult:
        """Implement `MaskedActingPolicy.act_on_all_slots`."""
        assert hidden_states is not None
        flat, replicas = self.flat, self.flat.replicas(parameters)
        features = flat.hidden_features(parameters, flat.rows(parameters, observed))
        from_input = np.matmul(parameters["gru_weight_input"], features)
        from_input += parameters["gru_bias_input"]
        before = flat.grouping.gather(hidden_states[None], replicas).swapaxes(1, 2)
        after = gated_step(from_input, before, parameters["gru_weight_memory"], parameters["gru_bias_memory"])
        actions, log_probs = flat.choose_actions(parameters, observed, flat.outputs(parameters, after), noise)
        next_states = flat.grouping.scatter(after.swapaxes(1, 2), replicas, steps=1)[0]
        if flat.spec.agents_come_and_go:
            next_states = np.where(observed.alive[..., None], next_states, hidden_states)
        return actions, log_probs, next_states

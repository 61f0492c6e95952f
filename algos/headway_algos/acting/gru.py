"""Acting from memory: the numpy twin of an actor with gated recurrent units."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import ActingPolicy, EnvSpec, Observations
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.live_agents import Answer, RecurrentActing
from headway_algos.acting.mlp import MLPActingPolicy, actor_outputs
from headway_algos.config import AlgoConfig


def acting_policy(config: AlgoConfig, spec: EnvSpec) -> ActingPolicy:
    """The policy of an algorithm's config on an environment, with or without memory."""
    flat = MLPActingPolicy.of(config, spec)
    return flat if config.model.core == "none" else GRUActingPolicy(flat, config.model.gru_size)


def gated_step(
    given: NDArray[Any], memory: NDArray[Any], weight: NDArray[Any], bias: NDArray[Any]
) -> NDArray[Any]:
    """The memory (P, M, B) after one step; see `headway_algos.networks.gru.gated_step`."""
    size = memory.shape[1]
    recalled = np.matmul(weight, memory)
    # The logistic function by tanh, which does not overflow.
    gates = given[:, : 2 * size] + recalled[:, : 2 * size]
    gates *= 0.5
    np.tanh(gates, out=gates)
    gates += 1
    gates *= 0.5
    reset, update = gates[:, :size], gates[:, size:]
    candidate = recalled[:, 2 * size :] + bias
    candidate *= reset
    candidate += given[:, 2 * size :]
    np.tanh(candidate, out=candidate)
    return np.asarray(candidate + update * (memory - candidate))


@dataclass(frozen=True)
class GRUActingPolicy(RecurrentActing):
    """P stacked policies whose hidden layers are followed by gated recurrent units.

    What an agent remembers changes with every observation that it is there for, whether or not its action
    is used.
    """

    flat: MLPActingPolicy
    """What comes before and after the units."""
    hidden_size: int
    """M"""

    @property
    def hidden_dtype(self) -> np.dtype[Any]:
        """As of the parameters."""
        return np.dtype(self.flat.precision)

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Those of the policy without memory, whose last layer is given the M numbers, and the units'."""
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
        """As without memory."""
        return self.flat.noise(generator, steps)

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """As agents act that remember nothing."""
        memory = np.zeros((*observed.alive.shape, self.hidden_size), self.hidden_dtype)
        return self.act_from(parameters, observed, memory, noise)[:2]

    @cached_property
    def alone(self) -> Self | None:
        """See `MaskedActingPolicy`."""
        return None if self.flat.alone is None else replace(self, flat=self.flat.alone)

    def replicas(self, parameters: Parameters) -> int:
        """See `MaskedActingPolicy`."""
        return self.flat.replicas(parameters)

    def answer(
        self,
        parameters: Parameters,
        observed: Observations,
        memory: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> Answer:
        """See `MaskedActingPolicy`."""
        assert memory is not None
        flat, replicas = self.flat, self.flat.replicas(parameters)
        features = flat.hidden_features(parameters, flat.rows(parameters, observed))
        given = np.matmul(parameters["gru_weight_input"], features)
        given += parameters["gru_bias_input"]
        before = flat.grouping.gather(memory[None], replicas).swapaxes(1, 2)
        after = gated_step(given, before, parameters["gru_weight_memory"], parameters["gru_bias_memory"])
        actions, log_probs = flat.decided(parameters, observed, flat.outputs(parameters, after), noise)
        remembered = flat.grouping.scatter(after.swapaxes(1, 2), replicas, steps=1)[0]
        if flat.spec.agents_come_and_go:
            remembered = np.where(observed.alive[..., None], remembered, memory)
        return actions, log_probs, remembered

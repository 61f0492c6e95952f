"""Acting policy with gated recurrent units, in numpy."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Observations, PolicyNetwork
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.live_agents import evaluate_live
from headway_algos.acting.mlp import MLPActingPolicy, actor_outputs


def gated_step(
    from_input: NDArray[Any], from_hidden: NDArray[Any], hidden_states: NDArray[Any], bias: NDArray[Any]
) -> NDArray[Any]:
    """Return the next hidden states (..., M).

    In the notation of `headway_algos.networks.gru`, `from_input` is W x + b and `from_hidden` is U h, (..., 3
    M) each, and `bias` is b_h (..., M).
    """
    size = hidden_states.shape[-1]
    # The logistic function by tanh, which does not overflow.
    gates = from_input[..., : 2 * size] + from_hidden[..., : 2 * size]
    gates *= 0.5
    np.tanh(gates, out=gates)
    gates += 1
    gates *= 0.5
    reset, update = gates[..., :size], gates[..., size:]
    candidate = from_hidden[..., 2 * size :] + bias
    candidate *= reset
    candidate += from_input[..., 2 * size :]
    np.tanh(candidate, out=candidate)
    return np.asarray(candidate + update * (hidden_states - candidate))


@dataclass(frozen=True)
class GRUActingPolicy:
    """P stacked policies with gated recurrent units between the hidden layers and the output layer.

    The hidden state of a live agent is updated at every step, whether or not its action is used.
    """

    any_block: ClassVar[bool] = True

    perceptron: MLPActingPolicy
    """Normalisation, hidden layers, output layer and action distribution."""
    hidden_size: int
    """M: number of units."""

    @property
    def hidden_dtype(self) -> np.dtype[Any]:
        """Dtype of hidden states: the dtype of the parameters."""
        return np.dtype(self.perceptron.precision)

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return the shapes of the feedforward layers and of the recurrent units."""
        perceptron, size = self.perceptron, self.hidden_size
        stack = replicas * perceptron.grouping.num_policies
        input_size = perceptron.hidden[-1] if perceptron.hidden else perceptron.input_size
        shapes = {
            f"weight_{len(perceptron.hidden)}": (stack, actor_outputs(perceptron.spec), size),
            "gru_weight_input": (stack, 3 * size, input_size),
            "gru_weight_memory": (stack, 3 * size, size),
            "gru_bias_input": (stack, 3 * size, 1),
            "gru_bias_memory": (stack, size, 1),
        }
        return perceptron.parameter_shapes(replicas) | {
            name: (s, self.hidden_dtype) for name, s in shapes.items()
        }

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Draw the random numbers of `MLPActingPolicy.noise`."""
        return self.perceptron.noise(generator, steps)

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Act from hidden states of 0."""
        hidden_states = np.zeros((*observed.alive.shape, self.hidden_size), self.hidden_dtype)
        return self.act_from(parameters, observed, hidden_states, noise)[:2]

    def act_from(
        self,
        parameters: Parameters,
        observed: Observations,
        hidden_states: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[Any]]:
        """Implement `headway.contracts.RecurrentPolicy.act_from`. Actions of agents not alive are 0."""
        outputs, after = self.evaluate_network(parameters, observed, hidden_states)
        actions, log_probs = self.perceptron.choose_actions(parameters, observed, outputs, noise)
        return actions, log_probs, np.where(observed.alive[..., None], after, hidden_states)

    @property
    def network(self) -> PolicyNetwork:
        """Implement `headway.contracts.DescribedPolicy.network`."""
        return replace(self.perceptron.network, hidden_size=self.hidden_size)

    def evaluate_network(
        self, parameters: Parameters, observed: Observations, hidden_states: NDArray[Any] | None
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Implement `headway.contracts.DescribedPolicy.evaluate_network`."""
        assert hidden_states is not None
        perceptron, alive, last = self.perceptron, observed.alive, len(self.perceptron.hidden)
        gates = parameters["gru_weight_input"], parameters["gru_bias_input"]
        inputs = perceptron.evaluate(parameters, observed, [*perceptron.layers(parameters, last), gates])
        weight, bias = parameters["gru_weight_memory"], parameters["gru_bias_memory"]
        no_bias = np.zeros((*weight.shape[:2], 1), self.hidden_dtype)
        products = evaluate_live(hidden_states, alive, perceptron.grouping, [(weight, no_bias)])
        policies = perceptron.grouping.policies(len(alive), perceptron.replicas(parameters))
        after = gated_step(inputs, products, hidden_states, bias[policies, :, 0])
        output = parameters[f"weight_{last}"], parameters[f"bias_{last}"]
        return evaluate_live(after, alive, perceptron.grouping, [output]), after

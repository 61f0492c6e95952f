"""Description of the network of an acting policy, with which it can be evaluated elsewhere."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from numpy.typing import NDArray

from headway.contracts.acting_policy import ActingPolicy, Parameters
from headway.contracts.environment import Observations


@dataclass(frozen=True)
class PolicyNetwork:
    """A multilayer perceptron per policy, optionally with gated recurrent units before the output layer.

    The input x of an agent is its observation, followed by its one-hot index if there are indices. With the
    arrays of its policy, by name, the network computes (the first line unless `observation_clip` is 0)

        x = clip((x - observation_mean) * observation_scale, -observation_clip, observation_clip)
        x = activation(weight_i x + bias_i)                            for each hidden layer i
        g, u = gru_weight_input x + gru_bias_input, gru_weight_hidden h      with recurrent units
        reset, update = sigmoid(g[:2M] + u[:2M])
        candidate = tanh(reset * (u[2M:] + gru_bias_hidden) + g[2M:])
        x = h = candidate + update * (h - candidate)
        outputs = weight_last x + bias_last

    Arrays have a leading axis of K policies. Biases are (K, size, 1), the normaliser (K, 1, inputs).
    """

    policy_of_agent: tuple[int, ...]
    """(N,): policy of each agent."""
    output: Literal["logits", "mean", "values", "tanh"]
    """`logits`: of one or several categoricals; `mean`: of a Gaussian with the log standard deviations
    `log_std` (K, A, 1); `values`: of actions, the largest of which is chosen; `tanh`: a deterministic action
    before its tanh, which is mapped to the bounds of the Box."""
    hidden_layers: int
    activation: Literal["tanh", "relu"]
    """Activation of the hidden layers."""
    hidden_size: int = 0
    """M: number of recurrent units; 0: none."""
    observation_clip: float = 0.0
    """Bound of normalised inputs; 0: inputs are neither normalised nor clipped."""
    index_of_agent: tuple[int, ...] = ()
    """(N,): index of each agent in its one-hot input; empty: there is none."""
    num_indices: int = 0
    """Length of the one-hot input."""

    @property
    def array_names(self) -> tuple[str, ...]:
        """Names of the arrays that the network reads."""
        names = ["observation_mean", "observation_scale"] if self.observation_clip else []
        names += [f"{kind}_{i}" for i in range(self.hidden_layers + 1) for kind in ("weight", "bias")]
        if self.hidden_size:
            names += ["gru_weight_input", "gru_weight_hidden", "gru_bias_input", "gru_bias_hidden"]
        return (*names, "log_std") if self.output == "mean" else tuple(names)


@runtime_checkable
class DescribedPolicy(ActingPolicy, Protocol):
    """An acting policy that can be exported, since its network is a `PolicyNetwork`."""

    @property
    def network(self) -> PolicyNetwork:
        """Description of the network."""
        ...

    def evaluate_network(
        self, parameters: Parameters, observed: Observations, hidden_states: NDArray[Any] | None
    ) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """Return the network's outputs (C, N, A) and the next hidden states, as `act` computes them.

        `hidden_states` (C, N, M): None for a network without recurrent units, as is then the second result.
        An export is compared with this. Rows of agents not alive are unspecified.
        """
        ...

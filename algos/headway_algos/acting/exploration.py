"""Exploring policies of the off-policy algorithms in numpy: epsilon-greedy and Ornstein-Uhlenbeck noise."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, Observations, PolicyNetwork
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.mlp import MLPActingPolicy

Shapes = dict[str, tuple[tuple[int, ...], np.dtype[Any]]]


@dataclass(frozen=True)
class ExploringPolicy:
    """P stacked networks, and the current exploration of each policy."""

    any_block: ClassVar[bool] = True

    OUTPUT: ClassVar[Literal["values", "tanh"]]
    """Meaning of the network's outputs; see `headway.contracts.PolicyNetwork.output`."""

    perceptron: MLPActingPolicy

    @property
    def network(self) -> PolicyNetwork:
        """Implement `headway.contracts.DescribedPolicy.network`."""
        return replace(self.perceptron.network, output=self.OUTPUT)

    def evaluate_network(
        self, parameters: Parameters, observed: Observations, hidden_states: NDArray[Any] | None
    ) -> tuple[NDArray[Any], None]:
        """Implement `headway.contracts.DescribedPolicy.evaluate_network`."""
        return self.perceptron.outputs(parameters, observed), None

    def parameter_shapes(self, replicas: int) -> Shapes:
        """Return the shapes of the networks' parameters and of `exploration` (P, 1, 1).

        `exploration` is epsilon, or the scale of the noise.
        """
        shapes = self.perceptron.parameter_shapes(replicas)
        shapes.pop("log_std", None)
        stack = replicas * self.perceptron.grouping.num_policies
        return shapes | {"exploration": ((stack, 1, 1), np.dtype(self.perceptron.precision))}

    def exploration(self, parameters: Parameters, copies: int) -> NDArray[np.float64]:
        """Return the exploration of each agent's policy, (C, N)."""
        policies = self.perceptron.grouping.policies(copies, self.perceptron.replicas(parameters))
        by_policy: NDArray[np.float64] = parameters["exploration"].astype(np.float64)[:, 0, 0]
        return by_policy[policies]


@dataclass(frozen=True)
class EpsilonGreedyPolicy(ExploringPolicy):
    """The best allowed action or, with probability epsilon, a uniformly random allowed one."""

    OUTPUT = "values"

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Draw uniforms (T, N, 2): one decides whether to explore, the other which action."""
        return generator.random((steps, self.perceptron.spec.num_agents, 2))

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Implement `headway.contracts.ActingPolicy.act`. Agents not alive get any action."""
        values = self.perceptron.outputs(parameters, observed)
        allowed = np.ones(values.shape, np.bool_)
        if observed.action_masks is not None:
            allowed = observed.action_masks | ~observed.alive[..., None]
        best: NDArray[np.int64] = np.where(allowed, values, -np.inf).argmax(axis=-1)
        epsilon = self.exploration(parameters, len(values))
        choices = allowed.sum(axis=-1)
        actions = best
        if noise is not None:
            drawn = (noise[..., 1] * choices).astype(np.int64)
            any_allowed = (allowed.cumsum(axis=-1) > drawn[..., None]).argmax(axis=-1)
            actions = np.where(noise[..., 0] < epsilon, any_allowed, best)
        return actions, np.log(epsilon / choices + (1 - epsilon) * (actions == best))


@dataclass(frozen=True)
class OrnsteinUhlenbeckPolicy(ExploringPolicy):
    """A deterministic policy with additive Ornstein-Uhlenbeck noise x:

        x' = (1 - theta) x + sigma n,   n standard normal;   action = m + h (tanh(network) + scale x')

    clipped to the action bounds m - h and m + h (Uhlenbeck and Ornstein 1930, discretised with step 1). The
    noise x is the agent's hidden state: 0 where its stream begins, unchanged while the agent is not alive.
    """

    OUTPUT = "tanh"

    theta: float
    sigma: float

    @property
    def hidden_size(self) -> int:
        """A: number of components of an action."""
        return len(self._box.low)

    @property
    def hidden_dtype(self) -> np.dtype[Any]:
        """Dtype of the noise x."""
        return np.dtype(np.float64)

    @property
    def _box(self) -> Box:
        space = self.perceptron.spec.action_space
        assert isinstance(space, Box)
        return space

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Draw standard normals (T, N, A)."""
        return generator.standard_normal((steps, self.perceptron.spec.num_agents, self.hidden_size))

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Act with noise state x = 0, as at the beginning of a stream."""
        hidden_states = np.zeros((*observed.alive.shape, self.hidden_size))
        return self.act_from(parameters, observed, hidden_states, noise)[:2]

    def act_from(
        self,
        parameters: Parameters,
        observed: Observations,
        hidden_states: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
        """Implement `headway.contracts.RecurrentPolicy.act_from`.

        Greedy acting leaves the noise state x unchanged. Log-probabilities are 0, since a deterministic
        policy has no density.
        """
        low, high = np.array(self._box.low), np.array(self._box.high)
        chosen = np.tanh(self.perceptron.outputs(parameters, observed))
        if noise is not None:
            scale = self.exploration(parameters, len(chosen))
            moved = (1 - self.theta) * hidden_states + self.sigma * noise
            hidden_states = np.where(observed.alive[..., None], moved, hidden_states)
            chosen = chosen + scale[..., None] * hidden_states
        actions = (low + high) / 2 + (high - low) / 2 * chosen
        return np.clip(actions, low, high).astype(np.float32), np.zeros(observed.alive.shape), hidden_states

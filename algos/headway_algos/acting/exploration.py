"""How the workers explore: epsilon-greedy choices and Ornstein-Uhlenbeck noise, in numpy."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, EnvSpec, Observations
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.live_agents import Answer, FeedforwardActing, RecurrentActing
from headway_algos.acting.mlp import MLPActingPolicy
from headway_algos.replay_config import ReplayConfig

Shapes = dict[str, tuple[tuple[int, ...], np.dtype[Any]]]


@dataclass(frozen=True)
class ExploringStack:
    """P networks evaluated at once, and how much each agent explores."""

    flat: MLPActingPolicy

    def parameter_shapes(self, replicas: int) -> Shapes:
        """Those of the networks, and `exploration` (P, 1, 1)."""
        shapes = self.flat.parameter_shapes(replicas)
        shapes.pop("log_std", None)
        stack = replicas * self.flat.grouping.num_policies
        return shapes | {"exploration": ((stack, 1, 1), np.dtype(self.flat.precision))}

    @property
    def alone(self) -> "ExploringStack | None":
        """See `MaskedActingPolicy`."""
        return None if self.flat.alone is None else ExploringStack(self.flat.alone)

    def outputs(self, parameters: Parameters, observed: Observations) -> NDArray[Any]:
        """What the networks give for each agent, (C, N, A)."""
        flat = self.flat
        features = flat.hidden_features(parameters, flat.rows(parameters, observed))
        by_row = flat.outputs(parameters, features)
        by_agent: NDArray[Any] = flat.grouping.scatter(by_row, flat.replicas(parameters), steps=1)[0]
        return by_agent

    def exploration(self, parameters: Parameters, copies: int) -> NDArray[np.float64]:
        """That of each agent, (C, N)."""
        flat, replicas = self.flat, self.flat.replicas(parameters)
        rows = flat.grouping.width * (copies // replicas)
        by_row = np.repeat(parameters["exploration"][:, 0].astype(np.float64), rows, axis=1)
        by_agent: NDArray[np.float64] = flat.grouping.scatter(by_row, replicas, steps=1)[0]
        return by_agent


@dataclass(frozen=True)
class EpsilonGreedyPolicy(FeedforwardActing):
    """The allowed action of the highest value, or with a chance of epsilon any allowed one."""

    stack: ExploringStack

    @classmethod
    def of(cls, config: ReplayConfig, spec: EnvSpec) -> "EpsilonGreedyPolicy":
        """The policy of an algorithm's config on an environment."""
        return cls(ExploringStack(MLPActingPolicy.of(config, spec)))

    def parameter_shapes(self, replicas: int) -> Shapes:
        """`exploration` is epsilon."""
        return self.stack.parameter_shapes(replicas)

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Uniforms (T, N, 2): whether to explore, and then which action."""
        return generator.random((steps, self.stack.flat.spec.num_agents, 2))

    @cached_property
    def alone(self) -> Self | None:
        """See `MaskedActingPolicy`."""
        return None if self.stack.alone is None else replace(self, stack=self.stack.alone)

    def replicas(self, parameters: Parameters) -> int:
        """See `MaskedActingPolicy`."""
        return self.stack.flat.replicas(parameters)

    def answer(
        self,
        parameters: Parameters,
        observed: Observations,
        memory: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> Answer:
        """See `MaskedActingPolicy`. Nothing is remembered."""
        values = self.stack.outputs(parameters, observed)
        allowed = np.ones(values.shape, np.bool_)
        if observed.action_masks is not None:
            allowed = observed.action_masks | ~observed.alive[..., None]
        best: NDArray[np.int64] = np.where(allowed, values, -np.inf).argmax(axis=-1)
        epsilon = self.stack.exploration(parameters, len(values))
        choices = allowed.sum(axis=-1)
        actions = best
        if noise is not None:
            drawn = (noise[..., 1] * choices).astype(np.int64)
            any_allowed = (allowed.cumsum(axis=-1) > drawn[..., None]).argmax(axis=-1)
            actions = np.where(noise[..., 0] < epsilon, any_allowed, best)
        return actions, np.log(epsilon / choices + (1 - epsilon) * (actions == best)), memory


@dataclass(frozen=True)
class OrnsteinUhlenbeckPolicy(RecurrentActing):
    """A deterministic action within the bounds, m + h tanh(network), that exploration lets wander around:

        x' = (1 - theta) x + sigma n,   n standard normal;   action = m + h (tanh(network) + scale x')

    cut at the bounds m - h and m + h (Uhlenbeck and Ornstein 1930, in steps of one). Each agent remembers its
    x, which is 0 where its stream begins and stands still while it is absent.
    """

    stack: ExploringStack
    theta: float
    sigma: float

    @classmethod
    def of(cls, config: ReplayConfig, spec: EnvSpec, theta: float, sigma: float) -> "OrnsteinUhlenbeckPolicy":
        """The policy of an algorithm's config on an environment with a bounded Box."""
        return cls(ExploringStack(MLPActingPolicy.of(config, spec)), theta, sigma)

    @property
    def hidden_size(self) -> int:
        """A: the size of an action."""
        return len(self._box.low)

    @property
    def hidden_dtype(self) -> np.dtype[Any]:
        """Of x."""
        return np.dtype(np.float64)

    @property
    def _box(self) -> Box:
        space = self.stack.flat.spec.action_space
        assert isinstance(space, Box)
        return space

    def parameter_shapes(self, replicas: int) -> Shapes:
        """`exploration` is the scale of the noise."""
        return self.stack.parameter_shapes(replicas)

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Standard normals (T, N, A)."""
        return generator.standard_normal((steps, self.stack.flat.spec.num_agents, self.hidden_size))

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """As where all streams begin."""
        memory = np.zeros((*observed.alive.shape, self.hidden_size))
        return self.act_from(parameters, observed, memory, noise)[:2]

    @cached_property
    def alone(self) -> Self | None:
        """See `MaskedActingPolicy`."""
        return None if self.stack.alone is None else replace(self, stack=self.stack.alone)

    def replicas(self, parameters: Parameters) -> int:
        """See `MaskedActingPolicy`."""
        return self.stack.flat.replicas(parameters)

    def answer(
        self,
        parameters: Parameters,
        observed: Observations,
        memory: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> Answer:
        """See `MaskedActingPolicy`. Greedy acting leaves x as it is. A deterministic policy has no density:
        log-probabilities are 0."""
        assert memory is not None
        low, high = np.array(self._box.low), np.array(self._box.high)
        chosen = np.tanh(self.stack.outputs(parameters, observed))
        if noise is not None:
            scale = self.stack.exploration(parameters, len(chosen))
            moved = (1 - self.theta) * memory + self.sigma * noise
            memory = np.where(observed.alive[..., None], moved, memory)
            chosen = chosen + scale[..., None] * memory
        actions = (low + high) / 2 + (high - low) / 2 * chosen
        return np.clip(actions, low, high).astype(np.float32), np.zeros(observed.alive.shape), memory

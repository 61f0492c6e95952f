"""Acting policy with multilayer perceptrons, in numpy; equals the torch actor to 1e-5."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, HeadwayError, Observations
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.live_agents import MIN_SLOTS, ActingResult, FeedforwardActing
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.replay_config import ReplayConfig

OBSERVATION_CLIP = 10.0
"""Normalised observations are clipped at this many standard deviations, as in OpenAI Baselines'
VecNormalize."""
_HALF_LOG_2_PI = 0.5 * np.log(2 * np.pi)


def layer_sizes(input_size: int, hidden: Sequence[int], output_size: int) -> list[tuple[int, int]]:
    """Return the (output, input) sizes of each layer of a multilayer perceptron."""
    sizes = [input_size, *hidden, output_size]
    return [(sizes[i + 1], sizes[i]) for i in range(len(sizes) - 1)]


def actor_outputs(spec: EnvSpec) -> int:
    """Return the number of network outputs per agent: logits (Discrete) or components of the mean (Box).

    Raises HeadwayError for MultiDiscrete actions.
    """
    match spec.action_space:
        case Discrete(n=n):
            return n
        case Box(low=low):
            return len(low)
        case _:
            raise HeadwayError(
                f"{spec.name} has MultiDiscrete actions; choose one with Discrete or Box actions"
            )


@dataclass(frozen=True)
class MLPActingPolicy(FeedforwardActing):
    """P stacked multilayer perceptrons, followed by a masked categorical or a diagonal Gaussian."""

    spec: EnvSpec
    grouping: Grouping
    hidden: tuple[int, ...]
    activation: str
    precision: str
    normalise: bool
    """Normalise and clip observations before the network."""

    @classmethod
    def of(cls, config: AlgoConfig | ReplayConfig, spec: EnvSpec) -> "MLPActingPolicy":
        """Return the policy of an algorithm's config for an environment."""
        actor_outputs(spec)
        model, grouping = config.model, Grouping.of(config.policies, spec)
        normalise = config.normalise_observations
        return cls(spec, grouping, model.hidden, model.activation, config.precision, normalise)

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return the shapes of layers, of `log_std` for Box actions, and of the observation normaliser."""
        stack, size, dtype = replicas * self.grouping.num_policies, self.spec.observation_size, self.precision
        outputs = actor_outputs(self.spec)
        shapes: dict[str, tuple[int, ...]] = {
            "observation_mean": (stack, 1, size),
            "observation_scale": (stack, 1, size),
        }
        for i, (out, in_) in enumerate(layer_sizes(size, self.hidden, outputs)):
            shapes[f"weight_{i}"] = (stack, out, in_)
            shapes[f"bias_{i}"] = (stack, out, 1)
        if isinstance(self.spec.action_space, Box):
            shapes["log_std"] = (stack, outputs, 1)
        return {name: (shape, np.dtype(dtype)) for name, shape in shapes.items()}

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Draw uniforms (T, N) for Discrete actions, standard normals (T, N, A) for Box."""
        if isinstance(self.spec.action_space, Discrete):
            return generator.random((steps, self.spec.num_agents))
        return generator.standard_normal((steps, self.spec.num_agents, actor_outputs(self.spec)))

    def act_on_all_slots(
        self,
        parameters: Parameters,
        observed: Observations,
        hidden_states: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> ActingResult:
        """Implement `MaskedActingPolicy.act_on_all_slots`, without recurrence."""
        x = self.hidden_features(parameters, self.rows(parameters, observed))
        return *self.choose_actions(parameters, observed, self.outputs(parameters, x), noise), hidden_states

    @cached_property
    def single_agent(self) -> Self | None:
        """The same policy for one agent that is always alive (see `MaskedActingPolicy`)."""
        spec = self.spec
        several = self.grouping.num_policies > 1
        if not spec.agents_come_and_go or several or spec.num_agents < MIN_SLOTS:
            return None
        single = replace(spec, agents=spec.agents[:1], groups=spec.groups[:1], agents_come_and_go=False)
        return replace(self, spec=single, grouping=Grouping.of("shared", single))

    def replicas(self, parameters: Parameters) -> int:
        """Return R, the number of replicas in `parameters`."""
        stack: int = parameters["observation_mean"].shape[0]
        return stack // self.grouping.num_policies

    def rows(self, parameters: Parameters, observed: Observations) -> NDArray[np.float32]:
        """Return observations by policy, (P, B, D), with zeros for agents not alive."""
        replicas = self.replicas(parameters)
        rows = self.grouping.gather(observed.observations[None], replicas)
        if self.spec.agents_come_and_go:
            # Not in place: rows can be a view of the environment's own array.
            alive = self.grouping.gather(observed.alive[None], replicas)
            rows = np.where(alive[..., None], rows, np.float32(0))
        return rows

    def choose_actions(
        self,
        parameters: Parameters,
        observed: Observations,
        outputs: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Return actions and log-probabilities (C, N), given network outputs (P, B, A)."""
        replicas = self.replicas(parameters)
        outputs = self.grouping.scatter(outputs, replicas, steps=1)[0]
        if isinstance(self.spec.action_space, Discrete):
            masks = observed.action_masks
            if masks is not None and self.spec.agents_come_and_go:
                masks = masks | ~observed.alive[..., None]
            return _sample_categorical(outputs, masks, noise)
        return _sample_gaussian(outputs, self._log_std(parameters, len(outputs)), noise)

    def _log_std(self, parameters: Parameters, copies: int) -> NDArray[Any]:
        """Return log standard deviations that broadcast to (C, N, A)."""
        replicas, log_std = self.replicas(parameters), parameters["log_std"][..., 0]
        if self.grouping.num_policies > 1:
            each = np.repeat(log_std[:, None], self.grouping.width, axis=1)
            by_agent = self.grouping.scatter(each, replicas, steps=1)[0]
        else:
            by_agent = log_std[:, None]
        return by_agent if replicas == 1 else np.repeat(by_agent, copies // replicas, axis=0)

    def hidden_features(self, parameters: Parameters, rows: NDArray[np.float32]) -> NDArray[Any]:
        """Return the last hidden layer's activations (P, features, B) for observations (P, B, D)."""
        x: NDArray[Any] = rows
        if self.normalise:
            x = (rows - parameters["observation_mean"]) * parameters["observation_scale"]
            # Twice as fast as `np.clip` if rows are few.
            np.minimum(np.maximum(x, -OBSERVATION_CLIP, out=x), OBSERVATION_CLIP, out=x)
        x = x.swapaxes(1, 2)
        for i in range(len(self.hidden)):
            x = np.matmul(parameters[f"weight_{i}"], x)
            x += parameters[f"bias_{i}"]
            x = np.tanh(x, out=x) if self.activation == "tanh" else np.maximum(x, 0, out=x)
        return x

    def outputs(self, parameters: Parameters, features: NDArray[Any]) -> NDArray[Any]:
        """Return network outputs (P, B, A) for inputs (P, features, B) of the output layer."""
        last = len(self.hidden)
        x = np.matmul(parameters[f"weight_{last}"], features)
        x += parameters[f"bias_{last}"]
        by_row: NDArray[Any] = x.swapaxes(1, 2)
        return by_row


def _sample_categorical(
    logits: NDArray[Any], masks: NDArray[np.bool_] | None, uniforms: NDArray[np.float64] | None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Sample by inverting the distribution function; forbidden actions have probability exactly 0."""
    if masks is not None:
        logits = np.where(masks, logits, -np.inf)
    shifted = logits - logits.max(axis=-1, keepdims=True)
    probabilities = np.exp(shifted)
    cumulative = probabilities.cumsum(axis=-1)
    total = cumulative[..., -1:]
    if uniforms is None:
        actions = logits.argmax(axis=-1)
    else:
        actions = (cumulative <= uniforms[..., None] * total).sum(axis=-1)
    chosen = np.take_along_axis(shifted, actions[..., None], axis=-1)
    return actions, (chosen - np.log(total))[..., 0].astype(np.float64)


def _sample_gaussian(
    mean: NDArray[Any], log_std: NDArray[Any], normals: NDArray[np.float64] | None
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return actions and log-densities. Actions are not clipped to the bounds: the environment clips."""
    if normals is None:
        normals = np.zeros(mean.shape)
    std = np.exp(log_std)
    actions = (mean + std * normals).astype(np.float32)
    standard = (actions - mean) / std
    log_prob = -0.5 * standard**2 - log_std - _HALF_LOG_2_PI
    return actions, log_prob.sum(axis=-1, dtype=np.float64)

"""The numpy twin of the actor, for workers that never import torch."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, HeadwayError, Observations
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.live_agents import FEWEST_SLOTS, Answer, FeedforwardActing
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.replay_config import ReplayConfig

OBSERVATION_CLIP = 10.0
"""Normalised observations are cut at this many standard deviations, as by OpenAI Baselines' VecNormalize."""
_HALF_LOG_2_PI = 0.5 * np.log(2 * np.pi)


def layer_sizes(input_size: int, hidden: Sequence[int], output_size: int) -> list[tuple[int, int]]:
    """(output, input) sizes of each layer of a multilayer perceptron."""
    sizes = [input_size, *hidden, output_size]
    return [(sizes[i + 1], sizes[i]) for i in range(len(sizes) - 1)]


def actor_outputs(spec: EnvSpec) -> int:
    """Numbers that the actor's network gives for one agent: logits, or a Gaussian's mean."""
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
    """P multilayer perceptrons evaluated at once, then a masked categorical or a diagonal Gaussian."""

    spec: EnvSpec
    grouping: Grouping
    hidden: tuple[int, ...]
    activation: str
    precision: str
    normalise: bool
    """Observations are normalised, and cut, before the network."""

    @classmethod
    def of(cls, config: AlgoConfig | ReplayConfig, spec: EnvSpec) -> "MLPActingPolicy":
        """The policy of an algorithm's config on an environment."""
        actor_outputs(spec)
        model, grouping = config.model, Grouping.of(config.policies, spec)
        normalise = config.normalise_observations
        return cls(spec, grouping, model.hidden, model.activation, config.precision, normalise)

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Names are those of the actor's tensors, besides the observation normaliser's mean and scale."""
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
        """Uniforms (T, N) for Discrete actions, standard normals (T, N, A) for Box."""
        if isinstance(self.spec.action_space, Discrete):
            return generator.random((steps, self.spec.num_agents))
        return generator.standard_normal((steps, self.spec.num_agents, actor_outputs(self.spec)))

    def answer(
        self,
        parameters: Parameters,
        observed: Observations,
        memory: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> Answer:
        """See `MaskedActingPolicy`. Nothing is remembered."""
        x = self.hidden_features(parameters, self.rows(parameters, observed))
        return *self.decided(parameters, observed, self.outputs(parameters, x), noise), memory

    @cached_property
    def alone(self) -> Self | None:
        """See `MaskedActingPolicy`."""
        spec = self.spec
        several = self.grouping.num_policies > 1
        if not spec.agents_come_and_go or several or spec.num_agents < FEWEST_SLOTS:
            return None
        single = replace(spec, agents=spec.agents[:1], groups=spec.groups[:1], agents_come_and_go=False)
        return replace(self, spec=single, grouping=Grouping.of("shared", single))

    def replicas(self, parameters: Parameters) -> int:
        """See `MaskedActingPolicy`."""
        stack: int = parameters["observation_mean"].shape[0]
        return stack // self.grouping.num_policies

    def rows(self, parameters: Parameters, observed: Observations) -> NDArray[np.float32]:
        """Observations by policy, (P, B, D), zeros where an agent is not alive."""
        replicas = self.replicas(parameters)
        rows = self.grouping.gather(observed.observations[None], replicas)
        if self.spec.agents_come_and_go:
            # Not in place: rows can be a view of the environment's own memory.
            alive = self.grouping.gather(observed.alive[None], replicas)
            rows = np.where(alive[..., None], rows, np.float32(0))
        return rows

    def decided(
        self,
        parameters: Parameters,
        observed: Observations,
        outputs: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Actions and log-probabilities (C, N) from network outputs (P, B, A)."""
        replicas = self.replicas(parameters)
        outputs = self.grouping.scatter(outputs, replicas, steps=1)[0]
        if isinstance(self.spec.action_space, Discrete):
            masks = observed.action_masks
            if masks is not None and self.spec.agents_come_and_go:
                masks = masks | ~observed.alive[..., None]
            return _sample_categorical(outputs, masks, noise)
        return _sample_gaussian(outputs, self._log_std(parameters, len(outputs)), noise)

    def _log_std(self, parameters: Parameters, copies: int) -> NDArray[Any]:
        """(C, N, A), with axes of one where all are the same."""
        replicas, log_std = self.replicas(parameters), parameters["log_std"][..., 0]
        if self.grouping.num_policies > 1:
            each = np.repeat(log_std[:, None], self.grouping.width, axis=1)
            by_agent = self.grouping.scatter(each, replicas, steps=1)[0]
        else:
            by_agent = log_std[:, None]
        return by_agent if replicas == 1 else np.repeat(by_agent, copies // replicas, axis=0)

    def hidden_features(self, parameters: Parameters, rows: NDArray[np.float32]) -> NDArray[Any]:
        """What the last hidden layer makes of observations (P, B, D): (P, features, B)."""
        x: NDArray[Any] = rows
        if self.normalise:
            x = (rows - parameters["observation_mean"]) * parameters["observation_scale"]
            # In half the time of `np.clip`, where rows are few.
            np.minimum(np.maximum(x, -OBSERVATION_CLIP, out=x), OBSERVATION_CLIP, out=x)
        x = x.swapaxes(1, 2)
        for i in range(len(self.hidden)):
            x = np.matmul(parameters[f"weight_{i}"], x)
            x += parameters[f"bias_{i}"]
            x = np.tanh(x, out=x) if self.activation == "tanh" else np.maximum(x, 0, out=x)
        return x

    def outputs(self, parameters: Parameters, features: NDArray[Any]) -> NDArray[Any]:
        """Network outputs (P, B, A) of what the output layer is given, (P, features, B)."""
        last = len(self.hidden)
        x = np.matmul(parameters[f"weight_{last}"], features)
        x += parameters[f"bias_{last}"]
        by_row: NDArray[Any] = x.swapaxes(1, 2)
        return by_row


def _sample_categorical(
    logits: NDArray[Any], masks: NDArray[np.bool_] | None, uniforms: NDArray[np.float64] | None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Actions by inverting the distribution function; forbidden actions have probability exactly 0."""
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
    """Actions, not clipped to the bounds (the environment clips), and their log-densities."""
    if normals is None:
        normals = np.zeros(mean.shape)
    std = np.exp(log_std)
    actions = (mean + std * normals).astype(np.float32)
    standard = (actions - mean) / std
    log_prob = -0.5 * standard**2 - log_std - _HALF_LOG_2_PI
    return actions, log_prob.sum(axis=-1, dtype=np.float64)

"""Acting policy with multilayer perceptrons, without torch; log-probabilities equal the torch actor's
within 1e-5."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, EnvSpec, Observations, PolicyNetwork
from headway.contracts.acting_policy import Parameters
from headway_algos.acting.live_agents import evaluate_live
from headway_algos.agent_id import agent_ids, with_ids
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.kernels import acting as kernel
from headway_algos.replay_config import ReplayConfig

Layer = tuple[NDArray[Any], NDArray[Any]]
"""Weights (P, outs, ins) and biases (P, outs, 1)."""
OBSERVATION_CLIP = 10.0
"""Normalised observations are clipped at this many standard deviations, as in OpenAI Baselines'
VecNormalize."""


def layer_sizes(input_size: int, hidden: Sequence[int], output_size: int) -> list[tuple[int, int]]:
    """Return the (output, input) sizes of each layer of a multilayer perceptron."""
    sizes = [input_size, *hidden, output_size]
    return [(sizes[i + 1], sizes[i]) for i in range(len(sizes) - 1)]


def actor_outputs(spec: EnvSpec) -> int:
    """Return the number of network outputs per agent.

    Outputs are logits (Discrete), the logits of all choices (MultiDiscrete) or the mean (Box).
    """
    space = spec.action_space
    return space.size if isinstance(space, Box) else sum(space.options)


@dataclass(frozen=True)
class MLPActingPolicy:
    """P stacked multilayer perceptrons, followed by masked categoricals or a diagonal Gaussian."""

    any_block: ClassVar[bool] = True

    spec: EnvSpec
    grouping: Grouping
    hidden: tuple[int, ...]
    activation: Literal["tanh", "relu"]
    precision: str
    normalise: bool
    """Normalise and clip observations before the network."""
    agent_ids: NDArray[np.float32]
    """(N, G): columns appended to each agent's observation; see `headway_algos.agent_id`."""

    @classmethod
    def of(cls, config: AlgoConfig | ReplayConfig, spec: EnvSpec) -> "MLPActingPolicy":
        """Return the policy of an algorithm's config for an environment."""
        model, grouping = config.model, Grouping.of(config.policies, spec)
        normalise = config.normalise_observations
        ids = agent_ids(config, spec)
        return cls(spec, grouping, model.hidden, model.activation, config.precision, normalise, ids)

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return the shapes of layers, of `log_std` for Box actions, and of the observation normaliser."""
        stack, size, dtype = replicas * self.grouping.num_policies, self.input_size, self.precision
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

    @property
    def input_size(self) -> int:
        """Number of components of an observation, including the appended columns."""
        return self.spec.observation_size + int(self.agent_ids.shape[1])

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        """Draw the random numbers for T steps.

        They are uniforms (T, N) for Discrete actions, uniforms (T, N, choices) for MultiDiscrete, and
        standard normals (T, N, A) for Box.
        """
        space = self.spec.action_space
        draw = generator.standard_normal if isinstance(space, Box) else generator.random
        return draw((steps, self.spec.num_agents, *space.shape))

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Implement `headway.contracts.ActingPolicy.act`. Actions of agents not alive are 0."""
        return self.choose_actions(parameters, observed, self.outputs(parameters, observed), noise)

    @property
    def network(self) -> PolicyNetwork:
        """Implement `headway.contracts.DescribedPolicy.network`."""
        return PolicyNetwork(
            policy_of_agent=tuple(self.grouping.policies(1, 1)[0].tolist()),
            output="mean" if isinstance(self.spec.action_space, Box) else "logits",
            hidden_layers=len(self.hidden),
            activation=self.activation,
            observation_clip=OBSERVATION_CLIP if self.normalise else 0.0,
            index_of_agent=tuple(self.agent_ids.argmax(1).tolist()) if self.agent_ids.shape[1] else (),
            num_indices=int(self.agent_ids.shape[1]),
        )

    def evaluate_network(
        self, parameters: Parameters, observed: Observations, hidden_states: NDArray[Any] | None
    ) -> tuple[NDArray[Any], None]:
        """Implement `headway.contracts.DescribedPolicy.evaluate_network`."""
        return self.outputs(parameters, observed), None

    def replicas(self, parameters: Parameters) -> int:
        """Return R, the number of replicas in `parameters`."""
        stack: int = parameters["observation_mean"].shape[0]
        return stack // self.grouping.num_policies

    def outputs(self, parameters: Parameters, observed: Observations) -> NDArray[Any]:
        """Return the network outputs of each agent, (C, N, A); 0 if it is not alive."""
        return self.evaluate(parameters, observed, self.layers(parameters, len(self.hidden) + 1))

    def layers(self, parameters: Parameters, count: int) -> list[Layer]:
        """Return the weights and biases of the first `count` layers."""
        return [(parameters[f"weight_{i}"], parameters[f"bias_{i}"]) for i in range(count)]

    def evaluate(self, parameters: Parameters, observed: Observations, layers: list[Layer]) -> NDArray[Any]:
        """Return the outputs (C, N, A) of layers for the normalised observations; 0 for agents not alive."""
        mean, scale = parameters["observation_mean"], parameters["observation_scale"]
        return evaluate_live(
            with_ids(observed.observations, self.agent_ids), observed.alive, self.grouping, layers,
            self.activation, (mean, scale, OBSERVATION_CLIP if self.normalise else 0.0),
        )  # fmt: skip

    def choose_actions(
        self,
        parameters: Parameters,
        observed: Observations,
        outputs: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Return actions and log-probabilities (C, N), given network outputs (C, N, A); 0 if not alive."""
        (copies, agents, size), space = outputs.shape, self.spec.action_space
        alive, log_probs = observed.alive.ravel(), np.empty(copies * agents)
        flat = outputs.reshape(-1, size)
        if isinstance(space, Box):
            actions = np.empty((copies * agents, size), np.float32)
            normals = np.empty((0, size)) if noise is None else np.ascontiguousarray(noise).reshape(-1, size)
            policies = self.grouping.policies(copies, self.replicas(parameters)).ravel()
            kernel.choose_gaussian(flat, alive, policies, parameters["log_std"], normals, actions, log_probs)
            return actions.reshape(copies, agents, size), log_probs.reshape(copies, agents)
        options = np.array(space.options)
        masks = np.empty((0, size), np.bool_)
        if observed.action_masks is not None:
            masks = np.ascontiguousarray(observed.action_masks).reshape(-1, size)
        uniforms = np.empty((0, len(options)))
        if noise is not None:
            uniforms = np.ascontiguousarray(noise).reshape(-1, len(options))
        chosen = np.empty((copies * agents, len(options)), np.int64)
        kernel.choose_categorical(flat, options, alive, masks, uniforms, np.empty(size), chosen, log_probs)
        return chosen.reshape(copies, agents, *space.shape), log_probs.reshape(copies, agents)

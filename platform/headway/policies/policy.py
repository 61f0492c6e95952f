"""A trained policy that acts in numpy, outside the platform."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from headway.contracts import ActionSpace, Box, HeadwayError, ObservationFeature
from headway.contracts.errors import one_line
from headway.contracts.spaces import allows_action
from headway.policies.description import Arrays, PolicyDescription
from headway.policies.network import Evaluation, evaluate, greedy_actions, in_environment_units

Array = NDArray[Any]
Evaluate = Callable[[Array, Array | None, Array | None], Evaluation]
"""(observations (B, N, D), action masks (B, N, A) or None, hidden states (B, N, M) or None) -> evaluation."""


def numpy_evaluation(description: PolicyDescription, arrays: Arrays) -> Evaluate:
    """Return the evaluation of a policy's network by numpy."""
    named = {**description.constants, **arrays}

    def evaluate_arrays(observations: Array, masks: Array | None, state: Array | None) -> Evaluation:
        return evaluate(np, description, named, observations.astype(description.precision), masks, state)

    return evaluate_arrays


class Policy:
    """A trained policy of N agents; see `headway.api.load_policy`.

    Observations are those of the training environment with its wrappers; actions are in its units. Only
    numpy is used, unless the policy was loaded from an ONNX or TorchScript file.
    """

    def __init__(self, description: PolicyDescription, evaluation: Evaluate) -> None:
        self.description = description
        self.evaluate = evaluation
        """Network evaluation for arrays of all agents, with the distribution's parameters."""
        self._index = {agent: index for index, agent in enumerate(description.agents)}

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the N agents, in the order of arrays."""
        return self.description.agents

    @property
    def observation_size(self) -> int:
        """D: length of an agent's observation."""
        return self.description.observation_size

    @property
    def observation_features(self) -> tuple[ObservationFeature, ...]:
        """The D numbers of an observation in order, with names, units and scales; empty: the environment does
        not describe them."""
        return self.description.observation_features

    @property
    def action_space(self) -> ActionSpace:
        """Action space of every agent: number of actions, or bounds."""
        return self.description.action_space

    @property
    def hidden_size(self) -> int:
        """M: length of an agent's hidden state; 0: the policy has none."""
        return self.description.network.hidden_size

    @property
    def origin(self) -> Mapping[str, Any]:
        """Run, algorithm, environment with its arguments, iteration and versions, as JSON values."""
        return self.description.origin

    def act(
        self,
        observations: ArrayLike | Mapping[str, ArrayLike],
        mask: ArrayLike | Mapping[str, ArrayLike] | None = None,
        deterministic: bool = True,
        state: ArrayLike | Mapping[str, ArrayLike] | None = None,
        generator: np.random.Generator | None = None,
    ) -> tuple[Any, Any]:
        """Return (actions, state) for the agents' observations.

        All arguments are arrays of all agents, or all are mappings from the names of some agents, as in
        PettingZoo; so are the results.

        `observations`: (..., N, D), or agent -> (D,); finite. Leave out agents that are not alive or, with
        arrays, give them any finite row, ignore their actions and restore their rows of `state`.
        `mask`: allowed actions, (..., N, A), or agent -> (A,); needed if and only if the environment has
        action masks. A is the number of actions, or of the options of all choices of a MultiDiscrete space.
        `deterministic`: act by the mode of the distribution, else sample from it with `generator` (None: a
        new one with an unpredictable seed).
        `state`: the hidden state returned for the previous step, (..., N, M), or agent -> (M,); None where an
        episode begins. Set the row of an agent that was terminated or truncated to 0, or remove the agent.

        Actions are int64 (..., N) for Discrete, int64 (..., N, choices) for MultiDiscrete, and float (..., N,
        A), clipped to the bounds, for Box. The returned state is None if `hidden_size` is 0.

        Raises HeadwayError for an argument that is missing, unknown, of another shape or not finite.
        """
        if not isinstance(generator, np.random.Generator | None):
            raise HeadwayError("generator must be a numpy.random.Generator, such as np.random.default_rng(0)")
        if isinstance(observations, Mapping):
            return self._act_by_agent(observations, mask, deterministic, state, generator)
        agents, rows = len(self.agents), _numbers("observations", observations, np.float32)
        if rows.ndim < 2 or rows.shape[-2:] != (agents, self.observation_size):
            raise HeadwayError(
                f"observations must be of shape (..., {agents}, {self.observation_size}), not {rows.shape}"
            )
        wrong = ~np.isfinite(rows).all(axis=(*range(rows.ndim - 2), -1))
        if wrong.any():
            raise HeadwayError(f"observations of {self.agents[int(wrong.argmax())]} are not finite")
        leading = rows.shape[:-2]
        masks = self._masks(mask, leading)
        hidden = self._hidden(state, leading)
        evaluation = self.evaluate(rows.reshape(-1, *rows.shape[-2:]), masks, hidden)
        actions = evaluation.actions
        if not deterministic:
            actions = self._sampled(evaluation.outputs, masks, generator or np.random.default_rng())
        actions = actions.reshape(*leading, *actions.shape[1:])
        if not self.hidden_size:
            return actions, None
        assert evaluation.state is not None
        return actions, evaluation.state.reshape(*leading, agents, self.hidden_size)

    def _act_by_agent(
        self,
        observations: Mapping[str, ArrayLike],
        mask: ArrayLike | Mapping[str, ArrayLike] | None,
        deterministic: bool,
        state: ArrayLike | Mapping[str, ArrayLike] | None,
        generator: np.random.Generator | None,
    ) -> tuple[dict[str, Any], dict[str, Any] | None]:
        for name, argument in (("mask", mask), ("state", state)):
            if argument is not None and not isinstance(argument, Mapping):
                raise HeadwayError(f"{name} must be a mapping from agents' names, as observations are")
        masks = None
        if isinstance(mask, Mapping):
            if missing := [agent for agent in observations if agent not in mask]:
                raise HeadwayError(f"mask lacks agent {missing[0]}, which is in observations")
            given = {agent: mask[agent] for agent in observations}
            masks = self._rows("mask", given, np.ones((len(self.agents), self._num_options), np.bool_))
        before: Mapping[str, ArrayLike] = state if isinstance(state, Mapping) else {}
        hidden = self._rows("state", before, np.zeros((len(self.agents), self.hidden_size), np.float64))
        zeros = np.zeros((len(self.agents), self.observation_size), np.float32)
        rows = self._rows("observations", observations, zeros)
        actions, after = self.act(
            rows, masks, deterministic, hidden if self.hidden_size else state, generator
        )
        chosen = {agent: actions[self._index[agent]] for agent in observations}
        if after is None:
            return chosen, None
        return chosen, {**before, **{agent: after[self._index[agent]] for agent in observations}}

    @property
    def _num_options(self) -> int:
        return sum(self.description.action_space.options)

    def _rows(self, name: str, given: Mapping[str, ArrayLike], rows: Array) -> Array:
        """Write one row per agent into `rows` (N, ...) and return it."""
        for agent, values in given.items():
            if agent not in self._index:
                some = ", ".join(self.agents[:3]) + (", ..." if len(self.agents) > 3 else "")
                raise HeadwayError(f"{name}: the policy has no agent {agent!r}; its agents are {some}")
            row = _numbers(f"{name} of {agent}", values, rows.dtype)
            if row.shape != rows.shape[1:]:
                raise HeadwayError(f"{name} of {agent} must be of shape {rows.shape[1:]}, not {row.shape}")
            rows[self._index[agent]] = row
        return rows

    def _masks(self, mask: object, leading: tuple[int, ...]) -> Array | None:
        if (mask is not None) != self.description.has_action_mask:
            if mask is None:
                raise HeadwayError("the policy needs the action masks of its environment: give mask")
            raise HeadwayError("the policy's environment has no action masks: leave mask out")
        if mask is None:
            return None
        masks = self._shaped("mask", _numbers("mask", mask, np.bool_), leading, self._num_options)
        if not allows_action(self.action_space, masks).all():
            raise HeadwayError(
                "mask allows an agent no action: leave out agents that are not alive, or set their rows "
                "to true"
            )
        return masks

    def _hidden(self, state: object, leading: tuple[int, ...]) -> Array | None:
        if not self.hidden_size:
            if state is not None:
                raise HeadwayError("the policy has no hidden state: leave state out")
            return None
        if state is None:
            state = np.zeros((*leading, len(self.agents), self.hidden_size))
        return self._shaped(
            "state", _numbers("state", state, self.description.precision), leading, self.hidden_size
        )

    def _shaped(self, name: str, array: Array, leading: tuple[int, ...], size: int) -> Array:
        """Return an array (..., N, size) as (B, N, size)."""
        wanted = (*leading, len(self.agents), size)
        if array.shape != wanted:
            raise HeadwayError(f"{name} must be of shape {wanted}, not {array.shape}")
        return array.reshape(-1, len(self.agents), size)

    def _sampled(self, outputs: Array, masks: Array | None, generator: np.random.Generator) -> Array:
        """Sample actions from distributions with the parameters `outputs`."""
        output = self.description.network.output
        if output not in ("logits", "mean"):
            raise HeadwayError(
                f"the policy of {self.origin.get('algorithm', 'this algorithm')} is deterministic and has no "
                "distribution to sample from; use deterministic=True"
            )
        if isinstance(self.action_space, Box):
            mean, log_std = np.split(outputs, 2, axis=-1)
            drawn = mean + np.exp(log_std) * generator.standard_normal(mean.shape)
            return np.asarray(in_environment_units(np, self.description.constants, drawn), outputs.dtype)
        # The largest of the logits plus Gumbel noise is a draw from their categorical.
        noisy = outputs + generator.gumbel(size=outputs.shape)
        return np.asarray(greedy_actions(np, self.description, noisy, masks))


def _numbers(name: str, values: object, dtype: DTypeLike) -> Array:
    try:
        return np.asarray(values).astype(dtype)
    except (TypeError, ValueError) as error:
        reset = isinstance(values, tuple) and any(isinstance(value, Mapping) for value in values)
        hint = "of PettingZoo's reset, pass the first of (observations, infos)" if reset else one_line(error)
        raise HeadwayError(f"{name} cannot be read as an array of numbers: {hint}") from error

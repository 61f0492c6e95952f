"""Elementwise changes of observations, in batched form.

They are SuperSuit's agent_indicator_v0, normalize_obs_v0, dtype_v0 and flatten_v0.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    BatchedWrapper,
    BatchWrapper,
    HeadwayError,
    ObservationBounds,
    ObservationFeature,
    Observations,
    StepResult,
)
from headway.contracts.checks import require_value
from headway.contracts.errors import InvalidValueError

Floats = NDArray[np.float32]
_TYPE_AND_NUMBER = re.compile(r"([a-z]+)_[0-9]+.*")
"""Form of agents' names that SuperSuit requires for `type_only`."""


@dataclass(frozen=True)
class AgentIndicator:
    """Arguments of agent_indicator_v0."""

    type_only: bool = False
    """Indicate the agent's type instead of the agent. Names must then have the form TYPE_NUMBER."""


@dataclass(frozen=True)
class NormalizeObs:
    """Arguments of normalize_obs_v0."""

    env_min: float = 0.0
    """New value of the observation space's lower bound."""
    env_max: float = 1.0
    """New value of the observation space's upper bound."""

    def __post_init__(self) -> None:
        require_value(
            self, "env_min", self.env_min < self.env_max, f"must be below env_max ({self.env_max:g})"
        )


@dataclass(frozen=True)
class DType:
    """Arguments of dtype_v0."""

    dtype: str
    """Name of a numpy dtype. Batches convert observations back to float32."""

    def __post_init__(self) -> None:
        try:
            np.dtype(self.dtype)
        except TypeError:
            problem = f"must name a numpy type such as float32, not {self.dtype}"
            raise InvalidValueError("dtype", problem) from None


@dataclass(frozen=True)
class NoArguments:
    """Arguments of wrappers that take none."""


class ChangedObservations(BatchWrapper):
    """Changes each observation by a function of its own values.

    `write(observations, out)` fills `out` (C, N, size) from `observations` (C, N, D). Rows of absent agents
    are unspecified before and after. `write` must be picklable. `appended`: features that follow the inner
    environment's, unchanged; None: the wrapper changes these, so none are described.
    """

    def __init__(
        self,
        inner: BatchedEnv,
        size: int,
        write: Callable[[Floats, Floats], None],
        appended: tuple[ObservationFeature, ...] | None = None,
    ) -> None:
        own = inner.spec.observation_features
        features = (*own, *appended) if own and appended is not None else ()
        super().__init__(inner, replace(inner.spec, observation_size=size, observation_features=features))
        self._write = write
        shape = (inner.num_copies, inner.spec.num_agents, size)
        self._observations = np.zeros(shape, dtype=np.float32)
        self._finals = np.zeros(shape, dtype=np.float32)

    def _begin(self, observed: Observations) -> Observations:
        with np.errstate(all="ignore"):  # absent agents' rows are unspecified
            self._write(observed.observations, self._observations)
        return replace(observed, observations=self._observations)

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        if outcome.terminated.any() or outcome.truncated.any():
            with np.errstate(all="ignore"):
                self._write(outcome.final_observations, self._finals)
        return replace(outcome, final_observations=self._finals), self._begin(observed)


def _append(suffix: Floats, observations: Floats, out: Floats) -> None:
    """Append the same numbers, (N, columns), to each agent's observations."""
    size = observations.shape[-1]
    out[..., :size] = observations
    out[..., size:] = suffix


def _normalize(bounds: ObservationBounds, new: NormalizeObs, observations: Floats, out: Floats) -> None:
    """Scale observations to new bounds, in SuperSuit's order of operations for equality to the last bit."""
    span = new.env_max - new.env_min
    out[...] = (observations - bounds.low) / (bounds.high - bounds.low) * span + new.env_min


def batched_agent_indicator(arguments: AgentIndicator, bounds: ObservationBounds) -> BatchedWrapper:
    """Return the batched form of agent_indicator_v0: one-hot columns in agents' order.

    The value of the hot column is the highest upper bound of the observations if all are finite, else 1.
    """
    types = [_agent_type(agent) if arguments.type_only else agent for agent in bounds.agents]
    columns = {agent_type: column for column, agent_type in enumerate(dict.fromkeys(types))}
    height = 1.0 if np.isinf(bounds.high).any() else bounds.high.max()
    suffix = np.zeros((len(types), len(columns)), dtype=np.float32)
    suffix[np.arange(len(types)), [columns[agent_type] for agent_type in types]] = height
    pad = np.full(len(columns), bounds.high.min(), dtype=np.float32)
    low, high = np.append(bounds.low, np.zeros_like(pad)), np.append(bounds.high, pad)
    features = tuple(
        ObservationFeature(f"is_{name}", f"1 for {name}, else 0", scale=1.0 / float(height or 1.0))
        for name in columns
    )
    wrap = partial(ChangedObservations, size=len(low), write=partial(_append, suffix), appended=features)
    return BatchedWrapper(wrap, replace(bounds, low=low, high=high))


def batched_normalize_obs(arguments: NormalizeObs, bounds: ObservationBounds) -> BatchedWrapper:
    """Return the batched form of normalize_obs_v0. Raises HeadwayError if a bound is not finite."""
    if not (np.isfinite(bounds.low).all() and np.isfinite(bounds.high).all()):
        raise HeadwayError(
            "normalize_obs_v0 needs finite bounds, and this environment's observations have none; "
            "leave it out (algo.normalise_observations learns the scale instead)"
        )
    wrap = partial(ChangedObservations, size=len(bounds.low), write=partial(_normalize, bounds, arguments))
    low, high = np.full_like(bounds.low, arguments.env_min), np.full_like(bounds.high, arguments.env_max)
    return BatchedWrapper(wrap, replace(bounds, low=low, high=high))


def batched_dtype(arguments: DType, bounds: ObservationBounds) -> BatchedWrapper | None:
    """Return the batched form of dtype_v0 for float32, which changes nothing; None for another dtype."""
    return unchanged(arguments, bounds) if np.dtype(arguments.dtype) == np.float32 else None


def unchanged(arguments: object, bounds: ObservationBounds) -> BatchedWrapper:
    """Return the batched form of a wrapper that has no effect here, such as flatten_v0."""
    return BatchedWrapper(BatchWrapper, bounds)


def _agent_type(agent: str) -> str:
    match = _TYPE_AND_NUMBER.match(agent)
    if match is None:
        raise HeadwayError(
            "agent_indicator_v0: with type_only, agents must be called type_number (in lower case), "
            f"not {agent}"
        )
    return match[1]

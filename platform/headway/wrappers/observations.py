"""Changes of each observation by itself: SuperSuit's agent_indicator_v0, normalize_obs_v0, dtype_v0 and
flatten_v0, for batches."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    BatchedWrapper,
    HeadwayError,
    ObservationBounds,
    Observations,
    StepResult,
)
from headway.wrappers.batch import BatchWrapper

Floats = NDArray[np.float32]
_TYPED = re.compile(r"([a-z]+)_[0-9]+.*")
"""As SuperSuit asks of agents' names for `type_only`."""


@dataclass(frozen=True)
class AgentIndicator:
    """Arguments of agent_indicator_v0."""

    type_only: bool = False
    """Tell types apart, not agents; names are then written TYPE_NUMBER."""


@dataclass(frozen=True)
class NormalizeObs:
    """Arguments of normalize_obs_v0."""

    env_min: float = 0.0
    """Where the lower bound of the observation space goes."""
    env_max: float = 1.0
    """Where the upper bound goes."""

    def __post_init__(self) -> None:
        if not self.env_min < self.env_max:
            raise ValueError(f"env_min must be below env_max, not {self.env_min} against {self.env_max}")


@dataclass(frozen=True)
class DType:
    """Arguments of dtype_v0."""

    dtype: str
    """Name of a numpy type. What agents learn from is float32 in the end."""

    def __post_init__(self) -> None:
        try:
            np.dtype(self.dtype)
        except TypeError:
            raise ValueError(f"dtype must name a numpy type such as float32, not {self.dtype}") from None


@dataclass(frozen=True)
class NoArguments:
    """Arguments of wrappers that take none."""


class ChangedObservations(BatchWrapper):
    """`write(observations, place)` fills `place`, (C, N, new size), from observations (C, N, D). Rows of
    absent agents may hold anything before and after."""

    def __init__(self, inner: BatchedEnv, size: int, write: Callable[[Floats, Floats], None]) -> None:
        super().__init__(inner, replace(inner.spec, observation_size=size))
        self._write = write
        shape = (inner.num_copies, inner.spec.num_agents, size)
        self._observations = np.zeros(shape, dtype=np.float32)
        self._finals = np.zeros(shape, dtype=np.float32)

    def _begin(self, observed: Observations) -> Observations:
        with np.errstate(all="ignore"):  # whatever absent agents' rows hold
            self._write(observed.observations, self._observations)
        return replace(observed, observations=self._observations)

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        if outcome.terminated.any() or outcome.truncated.any():
            with np.errstate(all="ignore"):
                self._write(outcome.final_observations, self._finals)
        return replace(outcome, final_observations=self._finals), self._begin(observed)


@dataclass(frozen=True)
class _Append:
    """The same numbers (N, more) at the end of each agent's observation."""

    more: Floats

    def __call__(self, observations: Floats, place: Floats) -> None:
        size = observations.shape[-1]
        place[..., :size] = observations
        place[..., size:] = self.more


@dataclass(frozen=True)
class _Normalize:
    """In SuperSuit's order of operations, for the same last bit."""

    low: Floats
    size: Floats
    env_min: float
    span: float

    def __call__(self, observations: Floats, place: Floats) -> None:
        place[...] = (observations - self.low) / self.size * self.span + self.env_min


def batched_agent_indicator(arguments: AgentIndicator, bounds: ObservationBounds) -> BatchedWrapper:
    """The twin of agent_indicator_v0: one-hot, in agents' order; its height is the highest bound of the
    observations if all are finite, else 1."""
    kinds = [_kind(agent) if arguments.type_only else agent for agent in bounds.agents]
    places = {kind: place for place, kind in enumerate(dict.fromkeys(kinds))}
    height = 1.0 if np.isinf(bounds.high).any() else bounds.high.max()
    more = np.zeros((len(kinds), len(places)), dtype=np.float32)
    more[np.arange(len(kinds)), [places[kind] for kind in kinds]] = height
    pad = np.full(len(places), bounds.high.min(), dtype=np.float32)
    low, high = np.append(bounds.low, np.zeros_like(pad)), np.append(bounds.high, pad)
    wrap = partial(ChangedObservations, size=len(low), write=_Append(more))
    return BatchedWrapper(wrap, replace(bounds, low=low, high=high))


def batched_normalize_obs(arguments: NormalizeObs, bounds: ObservationBounds) -> BatchedWrapper:
    """The twin of normalize_obs_v0. Raises HeadwayError where a bound is not finite."""
    if not (np.isfinite(bounds.low).all() and np.isfinite(bounds.high).all()):
        raise HeadwayError(
            "normalize_obs_v0 needs finite bounds, and this environment's observations have none; "
            "leave it out (algo.normalise_observations learns the scale instead)"
        )
    env_min, env_max = arguments.env_min, arguments.env_max
    write = _Normalize(bounds.low, bounds.high - bounds.low, env_min, env_max - env_min)
    wrap = partial(ChangedObservations, size=len(bounds.low), write=write)
    low, high = np.full_like(bounds.low, env_min), np.full_like(bounds.high, env_max)
    return BatchedWrapper(wrap, replace(bounds, low=low, high=high))


def batched_dtype(arguments: DType, bounds: ObservationBounds) -> BatchedWrapper | None:
    """The twin of dtype_v0 to float32, which changes nothing; none for another type."""
    return unchanged(arguments, bounds) if np.dtype(arguments.dtype) == np.float32 else None


def unchanged(arguments: object, bounds: ObservationBounds) -> BatchedWrapper:
    """The twin of a wrapper that changes nothing here, such as flatten_v0."""
    return BatchedWrapper(BatchWrapper, bounds)


def _kind(agent: str) -> str:
    match = _TYPED.match(agent)
    if match is None:
        raise HeadwayError(
            f"agent_indicator_v0: with type_only, agents are called type_number (in lower case), not {agent}"
        )
    return match[1]

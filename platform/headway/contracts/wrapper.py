"""Registry entries of wrappers, and a base class for batched wrappers.

Third parties register theirs by entry point (`headway.wrappers`), a mapping from name to entry.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.environment import BatchedEnv, EnvSpec, Observations, StepResult


@dataclass(frozen=True)
class ObservationBounds:
    """Bounds of what every agent observes: a float32 vector of D components."""

    agents: tuple[str, ...]
    """Names of the N agents, in array order."""
    low: NDArray[np.float32]
    """(D,): lower bounds; -inf where there is none."""
    high: NDArray[np.float32]
    """(D,): upper bounds; inf where there is none."""


@dataclass(frozen=True)
class BatchedWrapper:
    """The batched form of a wrapper. Its results must equal those of the PettingZoo form to the last bit."""

    wrap: Callable[[BatchedEnv], BatchedEnv]
    """(batched environment) -> wrapped environment. Must be picklable.

    Input rows of agents that are not alive hold what a ParallelEnv returns for them; zeros for a native
    environment. The result has two attributes that rules use: `inner`, the environment given, and
    `inner_observed`, its last observations.
    """
    bounds: ObservationBounds
    """Bounds of the wrapped environment's observations."""


@dataclass(frozen=True)
class WrapperEntry:
    """A named wrapper."""

    summary: str
    """One line for `headway list wrappers`."""
    config: type
    """Frozen dataclass of the wrapper's arguments, each field with a docstring. `__post_init__` raises
    ValueError for invalid values."""
    wrap: Callable[[Any, Any], Any]
    """(ParallelEnv, arguments) -> wrapped ParallelEnv.

    The infos `alive`, `acting`, `action_mask`, `slot_ended` and `episode_metrics` must pass through
    unchanged.
    """
    batched: Callable[[Any, ObservationBounds], BatchedWrapper | None] | None = None
    """(arguments, bounds of the environment to wrap) -> batched form; None if these arguments or bounds have
    none.

    Raises HeadwayError if an environment with these bounds cannot be wrapped. The field itself is None if the
    wrapper has no batched form.
    """
    only_rewards: bool = False
    """The wrapper changes nothing but rewards. It is then used in training only; evaluation and reports use
    the environment's own reward."""
    skips_steps: bool = False
    """One step of the wrapped environment is several steps of the inner one, and infos keep `acting` of the
    last of these only."""
    changes_actions: bool = False
    """Actions have another meaning after wrapping, so that the environment's own rules cannot be played."""


class BatchWrapper:
    """A batched environment around another one, `inner`. Snapshots work if those of `inner` do.

    This class changes nothing; subclasses override `_begin` and `_advance`.
    """

    def __init__(self, inner: BatchedEnv, spec: EnvSpec | None = None) -> None:
        """`spec` describes the wrapped environment; None: same as `inner`."""
        self.inner = inner
        self.inner_observed: Observations | None = None
        """Last observations of the inner environment, which rules inspect."""
        self._spec = spec or inner.spec

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return self.inner.num_copies

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        self.inner_observed = self.inner.reset(seeds)
        return self._begin(self.inner_observed)

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome, self.inner_observed = self.inner.step(actions)
        return self._advance(outcome, self.inner_observed)

    def snapshot(self) -> Any:  # noqa: ANN401 - the contract's type
        return self.inner.snapshot()

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401 - the contract's type
        self.inner_observed = self.inner.restore(snapshot)
        return self._begin(self.inner_observed)

    def close(self) -> None:
        self.inner.close()

    def _begin(self, observed: Observations) -> Observations:
        """Return the observations at the start of all episodes.

        Also called after `restore`, for a wrapper without state.
        """
        return observed

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        """Return the result and the observations of a step, given those of `inner`."""
        return outcome, observed

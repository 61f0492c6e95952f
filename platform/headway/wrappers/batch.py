"""The base class of batched wrappers."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, EnvSpec, Observations, StepResult


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
        """Return the observations at the start of all episodes, or after `restore` for a wrapper without
        state."""
        return observed

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        """Return the result and the observations of a step, given those of `inner`."""
        return outcome, observed


class ZeroAbsentObservations(BatchWrapper):
    """Sets rows of agents not alive to zero, as a ParallelEnv shows absent agents."""

    def __init__(self, inner: BatchedEnv) -> None:
        super().__init__(inner)
        spec = inner.spec
        shape = (inner.num_copies, spec.num_agents, spec.observation_size)
        self._observations = np.zeros(shape, dtype=np.float32)

    def _begin(self, observed: Observations) -> Observations:
        self._observations.fill(0)
        np.copyto(self._observations, observed.observations, where=observed.alive[..., None])
        return replace(observed, observations=self._observations)

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        return outcome, self._begin(observed)

"""A batched wrapper that zeroes the observations of absent agents."""

from dataclasses import replace

import numpy as np

from headway.contracts import BatchedEnv, BatchWrapper, Observations, StepResult


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

"""Hidden states of recurrent networks along a trajectory."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Layout
from headway_algos.batches.sequences import Sequences, over_rows
from headway_algos.batches.stream_ends import Truncations
from headway_algos.networks.gru import RecurrentNetwork


@dataclass(frozen=True)
class HiddenStates:
    """Hidden states of M components over T steps of C copies, for W inputs per copy (policies: N agents)."""

    before: NDArray[Any]
    """(T + 1, C, W, M): before each step, and after the last; 0 where a stream begins."""
    after: NDArray[Any]
    """(T, C, W, M): after the observation of each step, also where the stream ended with the step."""
    begins: NDArray[np.bool_]
    """(T, C, W): a stream begins with the step."""
    keeps: NDArray[np.bool_]
    """(T, C, W): the step has an observation, which updates the hidden state."""

    @classmethod
    def replay(
        cls,
        network: RecurrentNetwork,
        inputs: Tensor,
        start: NDArray[Any],
        begins: NDArray[np.bool_],
        keeps: NDArray[np.bool_],
        layout: Layout,
        piece_samples: int,
    ) -> Self:
        """Recompute hidden states from network inputs (P, B, in) of all steps.

        `start` (C, W, M) are the hidden states before the first step. `begins` (T + 1, C, W) has one more
        row, for the time after the last step.
        """
        steps = len(keeps)
        start = np.where(begins[0, ..., None], 0, start)
        whole = Sequences.of(layout, steps, start[None], begins[:-1], keeps)
        found = over_rows(network.hidden_states, inputs, whole, piece_samples)
        after = layout.grouping.scatter(found.cpu().numpy(), layout.replicas, steps)
        before = np.empty((steps + 1, *after.shape[1:]), after.dtype)
        before[0] = start
        for t in range(steps):
            np.copyto(after[t], before[t], where=~keeps[t, ..., None])
            before[t + 1] = np.where(begins[t + 1, ..., None], 0, after[t])
        return cls(before, after, begins[:-1], keeps)

    def sequences(self, layout: Layout, length: int) -> Sequences:
        """Cut the T steps into ceil(T / length) sequences per copy and input.

        Each sequence includes the hidden state before it.
        """
        return Sequences.of(layout, length, self.before[:-1:length], self.begins, self.keeps)

    @property
    def of_steps(self) -> NDArray[Any]:
        """(T, C, W, M): before each step."""
        return self.before[:-1]

    @property
    def after_last_step(self) -> NDArray[Any]:
        """(1, C, W, M): after the last step."""
        return self.before[-1:]

    def after_truncations(self, truncations: Truncations) -> NDArray[Any]:
        """Return the hidden states (F, R, W, M) at truncations, before they were reset."""
        return truncations.take(self.after)

"""What networks remembered along a trajectory."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.layout import Layout, Truncations
from headway_algos.batches.sequences import Sequences, over_rows
from headway_algos.networks.gru import RecurrentNetwork


@dataclass(frozen=True)
class HiddenStates:
    """M numbers at every moment of T steps of C copies, from W viewpoints (for policies: N agents)."""

    before: NDArray[Any]
    """(T + 1, C, W, M): before each step, and after the last; 0 where a stream begins."""
    after: NDArray[Any]
    """(T, C, W, M): right after what was seen at each step, of streams that ended with it, too."""
    begins: NDArray[np.bool_]
    """(T, C, W): a stream begins with the step."""
    keeps: NDArray[np.bool_]
    """(T, C, W): there was something to see."""

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
        """From what was remembered at the start (C, W, M), with network inputs (P, B, in) of all steps.
        `begins` has a row more, for what comes after the last step."""
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
        """The steps in sequences of `length`, each from what was remembered before its first step."""
        return Sequences.of(layout, length, self.before[:-1:length], self.begins, self.keeps)

    @property
    def of_steps(self) -> NDArray[Any]:
        """(T, C, W, M): before each step."""
        return self.before[:-1]

    @property
    def after_last_step(self) -> NDArray[Any]:
        """(1, C, W, M)"""
        return self.before[-1:]

    def after_truncations(self, truncations: Truncations) -> NDArray[Any]:
        """(F, R, W, M): of what ended there, before it was forgotten."""
        return truncations.take(self.after)

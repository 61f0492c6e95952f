"""Features of a block's live agents by policy, and layers of stacked networks on them."""

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from headway_algos.grouping import Grouping
from headway_algos.kernels import acting as kernel
from headway_algos.kernels.perceptron import ACTIVATIONS, layer
from headway_algos.kernels.products import LANES

Activation = Literal["linear", "tanh", "relu"]


@dataclass(frozen=True)
class LiveRows:
    """F features of each live agent in a block of C copies, ordered by policy.

    Layers are computed row by row, so a row's result does not depend on the other rows, to the last bit.
    """

    features: NDArray[Any]
    """(P, F, L): one lane per row; a policy's lanes from its `counts` on are padding."""
    slots: NDArray[np.int64]
    """(P, B): slot of each row, copy x N + agent."""
    counts: NDArray[np.int64]
    """(P,): number of rows of each policy."""
    shape: tuple[int, int]
    """(C, N)"""

    @classmethod
    def gather(
        cls,
        by_agent: NDArray[Any],
        alive: NDArray[np.bool_],
        grouping: Grouping,
        mean: NDArray[Any],
        scale: NDArray[Any],
        clip: float = 0.0,
    ) -> Self:
        """Return the features `by_agent` (C, N, F) of agents `alive` (C, N), in the dtype of `mean`.

        They are normalised by `mean` and `scale` (P, 1, F) and clipped at +-`clip`; unchanged if `clip` is 0.
        """
        copies, agents, size = by_agent.shape
        policies = len(mean)
        most = grouping.width * (copies * grouping.num_policies // policies)
        # Zeros, so that numpy may work on whole arrays without overflow in padding.
        features = np.zeros((policies, size, -(-most // LANES) * LANES), mean.dtype)
        slots, counts = np.empty((policies, most), np.int64), np.empty(policies, np.int64)
        kernel.gather(
            np.ascontiguousarray(by_agent).reshape(copies * agents, size), np.ascontiguousarray(alive),
            grouping.members, mean, scale, clip, slots, counts, features,
        )  # fmt: skip
        return cls(features, slots, counts, (copies, agents))

    def layer(self, weight: NDArray[Any], bias: NDArray[Any], activation: Activation = "linear") -> Self:
        """Return activation(W x + b), given weights (P, outputs, F) and biases (P, outputs, 1)."""
        policies, outs, _ = weight.shape
        features = np.empty((policies, outs, self.features.shape[2]), weight.dtype)
        apply = layer if weight.dtype == np.float32 else kernel.layer_in_float64
        apply(
            weight.reshape(policies, -1), bias.reshape(policies, outs), self.features, self.counts,
            ACTIVATIONS[activation], features,
        )  # fmt: skip
        return type(self)(features, self.slots, self.counts, self.shape)

    def by_agent(self) -> NDArray[Any]:
        """Return the features by agent (C, N, F), 0 for agents that are not alive."""
        size = self.features.shape[1]
        scattered = np.zeros((self.shape[0] * self.shape[1], size), self.features.dtype)
        kernel.scatter(self.features, self.slots, self.counts, scattered)
        return scattered.reshape(*self.shape, size)

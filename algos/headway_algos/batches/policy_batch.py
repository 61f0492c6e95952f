"""What every update of policies learns from: experience and advantages, laid out by policy."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.sequences import Sequences


@dataclass(frozen=True)
class PolicyBatch:
    """What the policies did, laid out by policy."""

    observations: Tensor
    """(P, B, D), normalised."""
    masks: Tensor | None
    """(P, B, A)"""
    actions: Tensor
    """(P, B) or (P, B, A)"""
    log_probs: Tensor
    """(P, B), at the parameters that acted."""
    selected: NDArray[np.bool_]
    """(P, B): the agent was alive and its action was used."""
    sequences: Sequences | None = None
    """Their order, for policies that remember."""

    def narrow(self, policies: Tensor) -> Self:
        """The rows of policies (n,) alone."""
        return type(self)(
            self.observations[policies],
            None if self.masks is None else self.masks[policies],
            self.actions[policies],
            self.log_probs[policies],
            self.selected[policies.cpu().numpy()],
            None if self.sequences is None else self.sequences.narrow(policies),
        )


def standardise(advantages: Tensor, selected: Tensor) -> Tensor:
    """Advantages (P, B) to mean 0 and standard deviation 1 over each policy's selected rows."""
    weight = selected.to(advantages.dtype)
    count = weight.sum(1, keepdim=True).clamp(min=1)
    mean = (advantages * weight).sum(1, keepdim=True) / count
    variance = ((advantages - mean) ** 2 * weight).sum(1, keepdim=True) / count
    return (advantages - mean) / (variance.sqrt() + 1e-8)

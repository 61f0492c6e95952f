"""Input of policy updates: an iteration's experience by policy, and standardised advantages."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.old_policies import OldPolicies
from headway_algos.batches.sequences import Sequences


@dataclass(frozen=True)
class PolicyBatch:
    """Observations, actions and log-probabilities of an iteration, by policy."""

    observations: Tensor
    """(P, B, D), normalised."""
    masks: Tensor | None
    """(P, B, A) action masks"""
    actions: Tensor
    """(P, B) for Discrete, (P, B, choices) for MultiDiscrete, (P, B, A) for Box"""
    log_probs: Tensor
    """(P, B), under the parameters that sampled the actions."""
    selected: NDArray[np.bool_]
    """(P, B): the agent was alive and its action was used."""
    sequences: Sequences | None = None
    """Order of the rows in time, for recurrent policies."""
    start: OldPolicies | None = None
    """Policies with which training started, if a penalty keeps the new ones near them."""

    def narrow(self, policies: Tensor) -> Self:
        """Return the rows of `policies` (n,)."""
        return type(self)(
            self.observations[policies],
            None if self.masks is None else self.masks[policies],
            self.actions[policies],
            self.log_probs[policies],
            self.selected[policies.cpu().numpy()],
            None if self.sequences is None else self.sequences.narrow(policies),
            None if self.start is None else self.start.narrow(policies),
        )


def standardise(advantages: Tensor, selected: Tensor) -> Tensor:
    """Standardise advantages (P, B) to mean 0 and standard deviation 1 over each policy's selected rows."""
    weight = selected.to(advantages.dtype)
    count = weight.sum(1, keepdim=True).clamp(min=1)
    mean = (advantages * weight).sum(1, keepdim=True) / count
    variance = ((advantages - mean) ** 2 * weight).sum(1, keepdim=True) / count
    return (advantages - mean) / (variance.sqrt() + 1e-8)

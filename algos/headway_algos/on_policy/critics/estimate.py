"""What a critic says of an iteration's experience."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.hidden_states import HiddenStates


@dataclass(frozen=True)
class CriticEstimate:
    """Judgement of T steps of C copies from W viewpoints (N agents, or 1 for a whole team), and what the
    critic is to learn from them."""

    advantages: NDArray[np.float64]
    """(T, C, W): how much better than usual the actions taken were."""
    values: NDArray[np.float64]
    """(T, C, W): V, or Q of the action taken."""
    returns: NDArray[np.float64]
    """(T, C, W): what the values should have been."""
    present: NDArray[np.bool_]
    """(T, C, W): where there is a value to speak of."""
    inputs: Tensor
    """Rows (P, B, input_size) of the critic's networks, normalised."""
    taken: Tensor | None = None
    """(P, B): which of the networks' outputs was meant; None where they have one."""
    hidden_states: HiddenStates | None = None
    """What the networks remembered, where they do."""
    target_hidden_states: HiddenStates | None = None
    """What a target network remembered, where there is one that does."""

"""A critic's estimates for one iteration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.hidden_states import HiddenStates


@dataclass(frozen=True)
class CriticEstimate:
    """Advantages and training data of the critic, for T steps of C copies and W viewpoints."""

    advantages: NDArray[np.float64]
    """(T, C, W): advantages of the actions taken."""
    values: NDArray[np.float64]
    """(T, C, W): V, or Q of the action taken."""
    returns: NDArray[np.float64]
    """(T, C, W): regression targets of the values."""
    present: NDArray[np.bool_]
    """(T, C, W): where a value exists."""
    inputs: Tensor
    """Rows (P, B, input_size) of the critic's networks, normalised."""
    taken: Tensor | None = None
    """(P, B): index of the action taken, for networks with one output per action; None with one output."""
    hidden_states: HiddenStates | None = None
    """Hidden states of the networks, if recurrent."""
    target_hidden_states: HiddenStates | None = None
    """Hidden states of the target network, if there is one and it is recurrent."""
    events: "CriticEstimate | None" = None
    """Estimate of the other agents' contribution, for the critic that separates it."""

"""Learners that keep the seeds of a stack apart."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Learner, Trajectory


class PerSeedLearner:
    """R learners of one seed each, behind the interface of one learner of R seeds.

    On a CPU the last bits of a batched matrix product depend on more than its factors. With MKL on an AMD
    processor they change with the number of rows, with the number of matrices in the batch (one, or several)
    and with the address of a matrix (a multiple of 16 bytes, or not). A seed learns bit for bit the same in
    any stack only if no product holds numbers of two seeds. The price is the share of torch's calls, which a
    stack would have divided by R: little where batches are large, most of the time where they are tiny.

    States and acting parameters have the layout of one learner of R seeds: a leading axis of R x K policies.
    """

    def __init__(self, learners: Sequence[Learner]) -> None:
        """`learners`: one per seed, in the order of the stack."""
        self.learners = tuple(learners)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """See `headway.contracts.Learner`."""
        each = [learner.acting_parameters() for learner in self.learners]
        return {name: np.concatenate([one[name] for one in each]) for name in each[0]}

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """Give each learner its own copies of the trajectory, which holds E copies per seed."""
        copies = trajectory.rewards.shape[1] // len(self.learners)
        each = [
            learner.update(trajectory.of_copies(r * copies, copies), iteration, progress)
            for r, learner in enumerate(self.learners)
        ]
        return {name: np.concatenate([one[name] for one in each]) for name in each[0]}

    def state_dict(self) -> dict[str, Any]:
        """See `headway.contracts.Learner`."""
        joined: dict[str, Any] = _joined([learner.state_dict() for learner in self.learners])
        return joined

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; takes the state of one learner of R seeds as well."""
        for r, learner in enumerate(self.learners):
            learner.load_state_dict(_split(state, r, len(self.learners)))


def _joined(states: Sequence[Any]) -> Any:  # noqa: ANN401 - states are nested plain values
    """Several states as one: tensors concatenated along their first axis, all else taken from the first."""
    first = states[0]
    if isinstance(first, Tensor):
        return torch.cat(list(states))
    if isinstance(first, Mapping):
        return {name: _joined([state[name] for state in states]) for name in first}
    if isinstance(first, list):
        return [_joined(parts) for parts in zip(*states, strict=True)]
    return first


def _split(state: Any, index: int, parts: int) -> Any:  # noqa: ANN401 - states are nested plain values
    """State `index` of `parts` equal parts: the inverse of `_joined`."""
    if isinstance(state, Tensor):
        return torch.tensor_split(state, parts)[index]
    if isinstance(state, Mapping):
        return {name: _split(value, index, parts) for name, value in state.items()}
    if isinstance(state, list):
        return [_split(value, index, parts) for value in state]
    return state

"""A stack of learners with one seed each, which never mixes seeds in one matrix product."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from headway.contracts import AnchoredLearner, LearnerWithReplay, Trajectory
from headway_algos.batches.nested_states import map_tensors

Learn = Callable[[Trajectory, int, Any], dict[str, NDArray[np.float64]]]
"""`Learner.update` or `Learner.imitate`."""


class PerSeedLearner:
    """R learners of one seed each, behind the interface of one learner of R seeds.

    On a CPU the last bits of a batched matrix product depend on more than its factors: with MKL on an AMD
    processor, on the number of rows, on whether the batch has one or several matrices, and on the alignment
    of a matrix to 16 bytes. A seed trains bit for bit the same in any stack only if no product contains
    numbers of two seeds. The cost is R times as many torch calls, which matters for small batches.

    States and acting parameters have the layout of one learner of R seeds: a leading axis of R x K policies.
    """

    def __init__(self, learners: Sequence[AnchoredLearner]) -> None:
        """`learners`: one per seed, in the order of the stack."""
        self.learners = tuple(learners)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """Return the learners' acting parameters, concatenated along the policy axis."""
        each = [learner.acting_parameters() for learner in self.learners]
        return {name: np.concatenate([one[name] for one in each]) for name in each[0]}

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """Update each learner with its own E copies of the trajectory; return their metrics, (R,) each."""
        return self._learn([learner.update for learner in self.learners], trajectory, iteration, progress)

    def imitate(
        self, trajectory: Trajectory, iteration: int, iterations: int
    ) -> dict[str, NDArray[np.float64]]:
        """Let each learner imitate the actions of its own E copies; return their metrics, (R,) each."""
        return self._learn([learner.imitate for learner in self.learners], trajectory, iteration, iterations)

    def anchor(self, kl_coeff: float, critic_only: bool) -> None:
        """Anchor each learner."""
        for learner in self.learners:
            learner.anchor(kl_coeff, critic_only)

    def _learn(
        self, ways: Sequence[Learn], trajectory: Trajectory, iteration: int, when: float
    ) -> dict[str, NDArray[np.float64]]:
        copies = trajectory.rewards.shape[1] // len(ways)
        each = [
            learn(trajectory.of_copies(r * copies, copies), iteration, when) for r, learn in enumerate(ways)
        ]
        return {name: np.concatenate([one[name] for one in each]) for name in each[0]}

    def replay_state(self) -> dict[str, Any] | None:
        """Return the learners' replay states, None if they have none."""
        states = [
            learner.replay_state() for learner in self.learners if isinstance(learner, LearnerWithReplay)
        ]
        return {"learners": states} if any(states) else None

    def load_replay_state(self, state: dict[str, Any]) -> None:
        """Continue from the result of `replay_state`."""
        for learner, own in zip(self.learners, state["learners"], strict=True):
            assert isinstance(learner, LearnerWithReplay)
            learner.load_replay_state(own)

    def start_from(self, state: dict[str, Any], replica: int, replicas: int, with_critic: bool) -> list[str]:
        """Let each learner start from the same policies; return the notices of one."""
        each = [learner.start_from(state, replica, replicas, with_critic) for learner in self.learners]
        return each[0]

    def state_dict(self) -> dict[str, Any]:
        """Return the learners' states as one, concatenated along the policy axis."""
        states = [learner.state_dict() for learner in self.learners]
        joined: dict[str, Any] = map_tensors(lambda *parts: torch.cat(parts), *states)
        return joined

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`, or the state of one learner of R seeds."""
        count = len(self.learners)
        for r, learner in enumerate(self.learners):
            own = map_tensors(lambda tensor, r=r: torch.tensor_split(tensor, count)[r], state)
            learner.load_state_dict(own)

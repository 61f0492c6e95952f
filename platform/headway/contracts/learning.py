"""What the training loop asks of an algorithm."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from headway.contracts.trajectory import Trajectory


class Learner(Protocol):
    """All learnable tensors of R replicas x K policies, and how experience changes them."""

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """What the acting policy needs, each with leading axis P. The caller copies them."""
        ...

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """Learn from one iteration's experience; `progress` is the share of the budget already used, for
        schedules. Returns metrics by `group/name`, each of shape (R,).

        Raises HeadwayError, naming seed and iteration, where learning diverged: where what acts is no
        longer finite.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly: tensors, numbers, strings, lists and dicts of these."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


@runtime_checkable
class ReplayingLearner(Learner, Protocol):
    """A learner that keeps its experience and learns from it again.

    Experience can be a thousand times as large as all else, and is of no use once training is over: it is
    kept in a file of its own, only as long as a run may go on.
    """

    def experience(self) -> dict[str, Any]:
        """What is needed to go on exactly besides `state_dict`, of the same kinds of value."""
        ...

    def load_experience(self, experience: dict[str, Any]) -> None: ...

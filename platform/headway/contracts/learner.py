"""What the training loop asks of an algorithm."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from headway.contracts.acting_policy import Parameters
from headway.contracts.trajectory import Trajectory


class Learner(Protocol):
    """All learnable tensors of R replicas x K policies, and how experience changes them."""

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """What the acting policy needs, each with leading axis P and in C order, so that products of them are
        rounded alike wherever they go. The caller copies them."""
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
class LearnerWithReplay(Learner, Protocol):
    """A learner that keeps its experience and learns from it again.

    Experience can be a thousand times as large as all else, and is of no use once training is over: it is
    kept in a file of its own, only as long as a run may go on.
    """

    def experience(self) -> dict[str, Any]:
        """What is needed to go on exactly besides `state_dict`, of the same kinds of value."""
        ...

    def load_experience(self, experience: dict[str, Any]) -> None: ...


@dataclass(frozen=True)
class Contribution:
    """What a worker's rollout is to change: gradients, and whatever else it tells the learner."""

    arrays: Parameters
    metrics: Mapping[str, NDArray[np.float64]]
    """By `group/name`, each (R,)."""


class Contributor(Protocol):
    """The part of an asynchronous learner that is at work in each worker, for some copies of one seed."""

    def adopt(self, published: Parameters) -> Parameters:
        """Go on from what the learner published; what the acting policy needs, as it is until
        `contribute`."""
        ...

    def contribute(self, trajectory: Trajectory, number: int) -> Contribution:
        """What this experience is to change. `number` is of the contribution: from 1, in the order in which
        workers were given them to do, so that no two of a run have the same, also of several workers; draws
        are named by it. Raises HeadwayError, naming seed and number, as `Learner.update` does."""
        ...

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque, plain
        """Whatever it carries from one trajectory to the next besides what is published."""
        ...

    def restore(self, snapshot: Any) -> None: ...  # noqa: ANN401 - opaque, plain


@runtime_checkable
class AsynchronousLearner(Learner, Protocol):
    """A learner that applies what workers contribute, each from parameters that others may have changed
    meanwhile."""

    @property
    def in_turns(self) -> bool:
        """Workers contribute in a fixed order, so that the same again is the same; else as they come."""
        ...

    def published(self) -> dict[str, NDArray[Any]]:
        """A copy of all that learning changes and contributors need."""
        ...

    def apply(self, contribution: Contribution, iteration: int, progress: float) -> None:
        """Make one update; `iteration`, `progress` and what is raised as for `update`."""
        ...

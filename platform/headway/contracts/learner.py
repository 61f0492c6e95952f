"""Learners: what the training loop requires of an algorithm."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from headway.contracts.acting_policy import Parameters
from headway.contracts.trajectory import Trajectory


class Learner(Protocol):
    """Parameters of R replicas x K policies, with their critics and optimisers, and the update rule."""

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that the acting policy reads, each with leading axis P and in C order.

        C order keeps the rounding of matrix products the same wherever the arrays are sent. The caller copies
        them.
        """
        ...

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """Learn from one iteration's trajectory and return metrics by `group/name`, each of shape (R,).

        `iteration` counts from 1. `progress`, in [0, 1), is the share of the step budget used before this
        iteration, for schedules. Raises HeadwayError, naming seed and iteration, if learning diverged: a
        parameter of the acting policy is no longer finite.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything needed to continue exactly.

        Allowed are tensors, numbers, strings, and lists and dicts of these.
        """
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the result of `state_dict`."""
        ...


@runtime_checkable
class LearnerWithReplay(Learner, Protocol):
    """A learner that keeps data to learn from later: a replay buffer, or a rule's decisions until they are
    imitated.

    Replay data can be a thousand times larger than all other state and is useless once training is over. It
    is therefore stored in a separate file, which is deleted when the run is finished.
    """

    def replay_state(self) -> dict[str, Any] | None:
        """Return the replay data needed, in addition to `state_dict`, to continue exactly; None: none now.

        Its values have the types allowed in `state_dict`.
        """
        ...

    def load_replay_state(self, state: dict[str, Any]) -> None:
        """Continue from the result of `replay_state`."""
        ...


@runtime_checkable
class ContinuingLearner(Learner, Protocol):
    """A learner that keeps unfinished experience of the running episodes from one iteration to the next."""

    def begin_episodes(self) -> None:
        """Drop that experience: the next trajectory begins with new episodes, as at the start of a stage."""
        ...


@runtime_checkable
class StartingLearner(Learner, Protocol):
    """A learner that can start from a rule or from another run."""

    def imitate(
        self, trajectory: Trajectory, iteration: int, iterations: int
    ) -> dict[str, NDArray[np.float64]]:
        """Learn from an iteration in which a rule acted; result and errors are those of `update`.

        `trajectory.actions` are the rule's, in the units of policies, and `log_probs` are 0. The rule acts in
        the first `iterations` iterations; `iteration` counts from 1. After the last of them, the policies
        must have been trained.
        """
        ...

    def start_from(self, state: dict[str, Any], replica: int, replicas: int, with_critic: bool) -> list[str]:
        """Take over the policies of another run, the same for all replicas; return notices.

        `state` is the `state_dict` of a learner of `replicas` replicas; the policies of replica `replica` are
        taken, which have the shapes of this learner's. `with_critic`: take over the critic too, if it fits.
        Raises HeadwayError if the state cannot be used.
        """
        ...


@runtime_checkable
class AnchoredLearner(StartingLearner, Protocol):
    """A learner that can stay near the policies with which it started."""

    def anchor(self, kl_coeff: float, critic_only: bool) -> None:
        """Set how the next `update` treats the policies. Called before every update.

        `kl_coeff`: coefficient of a penalty KL(start policy || policy); the start policies are those at the
        first call in which it is above 0. `critic_only`: leave the policies' parameters unchanged.
        """
        ...


@dataclass(frozen=True)
class Contribution:
    """A worker's result in asynchronous training: gradients and other inputs of the shared update."""

    arrays: Parameters
    """Named arrays, whose meaning is agreed between contributor and learner."""
    metrics: Mapping[str, NDArray[np.float64]]
    """Metrics by `group/name`, each of shape (R,)."""


class Contributor(Protocol):
    """The part of an asynchronous algorithm that runs in each worker, on some copies of one seed."""

    def adopt(self, published: Parameters) -> Parameters:
        """Load the parameters that the learner published; return those that the acting policy reads.

        The worker samples with the returned arrays; they must not change before `contribute` returns.
        """
        ...

    def contribute(self, trajectory: Trajectory, number: int) -> Contribution:
        """Return what the learner needs from this trajectory.

        `number` identifies the contribution: it counts from 1 over all workers of the run, in the order in
        which they were assigned, and is never used twice. Random draws use it as an index. Raises
        HeadwayError, naming seed and number, if learning diverged.
        """
        ...

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque, plain
        """Return the state carried from one trajectory to the next, without the published parameters.

        Its values have the types allowed in `BatchedEnv.snapshot`.
        """
        ...

    def restore(self, snapshot: Any) -> None:  # noqa: ANN401 - opaque, plain
        """Continue from the result of `snapshot`."""
        ...


@runtime_checkable
class AsynchronousLearner(Learner, Protocol):
    """A learner that applies workers' contributions, each computed from possibly outdated parameters."""

    @property
    def in_turns(self) -> bool:
        """Whether contributions are applied in a fixed order of workers, so that a rerun is exact.

        False: they are applied in order of arrival.
        """
        ...

    def published(self) -> dict[str, NDArray[Any]]:
        """Return a copy of every parameter and statistic that contributors need."""
        ...

    def apply(self, contribution: Contribution, iteration: int, progress: float) -> None:
        """Make one update from a contribution.

        `iteration`, `progress` and errors are those of `Learner.update`.
        """
        ...

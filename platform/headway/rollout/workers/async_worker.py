"""Workers of asynchronous training: each samples and computes contributions for the learner."""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from headway.contracts import Contributor, EnvSpec, HeadwayError, Trajectory
from headway.rollout.plan import RolloutPlan, Shard, copies_limit_text
from headway.rollout.sampler import Sampler
from headway.rollout.workers.shared_memory import SharedPickle
from headway.rollout.workers.usage import OwnUsage
from headway.rollout.workers.worker import Begin, Collect, Command, Contribute, Done, Evaluate, Restore

MakeContributor = Callable[[Any, EnvSpec, Sequence[int]], Contributor]
"""An algorithm entry's `contributor`."""


@dataclass(frozen=True)
class AsynchronousPlan:
    """The rollout plan of one seed and its algorithm's contributor. Picklable."""

    rollout: RolloutPlan
    """Plan of a single seed."""
    make_contributor: MakeContributor
    algo_config: Any
    preload: tuple[str, ...] = ()
    """The algorithm entry's `preload`."""

    @property
    def shards(self) -> list[Shard]:
        """Shards of one block each, so that all rollouts have the same size.

        Raises HeadwayError if a block exceeds the environment's limit of copies per process.
        """
        rollout, limit = self.rollout, self.rollout.spec.max_copies_per_process
        if limit is not None and rollout.block > limit:
            block = max(size for size in range(1, limit + 1) if rollout.copies % size == 0)
            raise HeadwayError(
                f"{copies_limit_text(rollout.spec, limit)}, and a worker, which has a block of copies, would "
                f"hold {rollout.block}; set rollout.block={block}"
            )
        return rollout.shards(rollout.copies // rollout.block)

    def require_workers(self, snapshots: Sequence[Any]) -> None:
        """Raise HeadwayError unless a checkpoint has one snapshot per worker."""
        rollout, workers = self.rollout, len(snapshots)
        if workers != len(self.shards):
            raise HeadwayError(
                f"the checkpoint was made with {workers} workers, not with {len(self.shards)}, and a worker "
                f'has a block of the copies; set "block" of "rollout" in the run\'s plan.json to '
                f"{rollout.copies // max(workers, 1)}"
            )


@dataclass(frozen=True)
class ContributorSetup:
    """Setup of a worker that contributes."""

    plan: SharedPickle[AsynchronousPlan] | bytes
    """A pickled `AsynchronousPlan`, in shared memory if the worker is on this machine."""
    shard: Shard

    def open(self) -> "ContributionService":
        """Return the contribution service."""
        pickled = self.plan
        plan: AsynchronousPlan = pickle.loads(pickled) if isinstance(pickled, bytes) else pickled.load()
        return ContributionService(plan, self.shard)


class ContributionService:
    """The service of a worker that contributes: a sampler of one seed's copies and a contributor."""

    def __init__(self, plan: AsynchronousPlan, shard: Shard) -> None:
        self.trajectory = Trajectory.allocate(replace(plan.rollout, copies=shard.count).layout)
        self.sampler = Sampler(plan.rollout, shard, self.trajectory, own=True)
        self.contributor = plan.make_contributor(plan.algo_config, plan.rollout.spec, plan.rollout.seeds)
        self.own_usage = OwnUsage()

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque, plain
        """Return the state between two contributions; None if the environment has no snapshots."""
        sampler = self.sampler.snapshot()
        return None if sampler is None else {"sampler": sampler, "learned": self.contributor.snapshot()}

    def execute(self, command: Command) -> Done:
        """Execute a command."""
        done = Done([], [], None, self.own_usage.read())
        match command:
            case Begin(purpose=purpose):
                self.sampler.begin(purpose)
            case Restore(snapshot=snapshot):
                self.sampler.restore(snapshot["sampler"])
                self.contributor.restore(snapshot["learned"])
            case Contribute(number=number, published=published):
                episodes = self.sampler.collect(number, self.contributor.adopt(published))
                contribution = self.contributor.contribute(self.trajectory, number)
                done = replace(done, episodes=episodes, contribution=contribution)
            case Collect() | Evaluate():
                raise TypeError(f"a contributing worker cannot execute {command}")
        return replace(done, snapshot=self.snapshot(), usage=self.own_usage.read())

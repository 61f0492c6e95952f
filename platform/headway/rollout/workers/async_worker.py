"""What a worker of the asynchronous mode does: roll out, and say what the learner is to make of it."""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from headway.contracts import Contributor, EnvSpec, HeadwayError, Trajectory
from headway.rollout.plan import RolloutPlan, Shard, process_holds
from headway.rollout.sampler import Sampler
from headway.rollout.workers.shared_memory import SharedPickle
from headway.rollout.workers.usage import OwnUsage
from headway.rollout.workers.worker import Begin, Collect, Command, Contribute, Done, Evaluate, Restore

MakeContributor = Callable[[Any, EnvSpec, Sequence[int]], Contributor]
"""An algorithm entry's `contributor`."""


@dataclass(frozen=True)
class AsynchronousPlan:
    """What decides what the workers do. Picklable."""

    rollout: RolloutPlan
    """Of one seed."""
    make_contributor: MakeContributor
    algo_config: Any
    preload: tuple[str, ...] = ()
    """The algorithm entry's."""

    @property
    def shards(self) -> list[Shard]:
        """What each worker holds: one block of the copies, so that every rollout is as long.

        Raises HeadwayError where a block is more than the environment allows in a process.
        """
        rollout, limit = self.rollout, self.rollout.spec.max_copies_per_process
        if limit is not None and rollout.block > limit:
            block = max(size for size in range(1, limit + 1) if rollout.copies % size == 0)
            raise HeadwayError(
                f"{process_holds(rollout.spec, limit)}, and a worker, which has a block of copies, would "
                f"hold {rollout.block}; set rollout.block={block}"
            )
        return rollout.shards(rollout.copies // rollout.block)

    def require_workers(self, snapshots: Sequence[Any]) -> None:
        """Raise HeadwayError unless a checkpoint has one snapshot a worker."""
        rollout, workers = self.rollout, len(snapshots)
        if workers != len(self.shards):
            raise HeadwayError(
                f"the checkpoint was made with {workers} workers, not with {len(self.shards)}, and a worker "
                f'has a block of the copies; let "block" of "rollout" in the run\'s plan.json be '
                f"{rollout.copies // max(workers, 1)}"
            )


@dataclass(frozen=True)
class ContributorSetup:
    """All that such a worker is given when it starts."""

    plan: SharedPickle[AsynchronousPlan] | bytes
    """An `AsynchronousPlan`; pickled, where memory cannot be shared."""
    shard: Shard

    def open(self) -> "Contributing":
        """The service of a worker that contributes."""
        pickled = self.plan
        plan: AsynchronousPlan = pickle.loads(pickled) if isinstance(pickled, bytes) else pickled.load()
        return ContributionService(plan, self.shard)


class ContributionService:
    """Some copies of one seed, and a contributor that learns from them."""

    def __init__(self, plan: AsynchronousPlan, shard: Shard) -> None:
        self.trajectory = Trajectory.allocate(replace(plan.rollout, copies=shard.count).layout)
        self.sampler = Sampler(plan.rollout, shard, self.trajectory, own=True)
        self.contributor = plan.make_contributor(plan.algo_config, plan.rollout.spec, plan.rollout.seeds)
        self.own_usage = OwnUsage()

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque, plain
        """Where it stands between two contributions, or None if the environment cannot tell."""
        sampler = self.sampler.snapshot()
        return None if sampler is None else {"sampler": sampler, "learned": self.contributor.snapshot()}

    def execute(self, command: Command) -> Done:
        """Do as told."""
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
                raise TypeError(f"a worker that contributes was told to {command}")
        return replace(done, snapshot=self.snapshot(), usage=self.own_usage.read())

"""The Ray cluster on which one session has its rollout workers, or its training processes whole."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from headway.config.experiment import BackendConfig
from headway.contracts.errors import HeadwayError
from headway.rollout.workers.ray_cluster import connect, disconnect
from headway_launch.runner.jobs import CoreShares, PlannedJob, share_cores
from headway_launch.runner.scheduler import Training
from headway_launch.runner.training_process import TrainingProcess

if TYPE_CHECKING:
    from headway.training.loop import TrainingJob


@dataclass(frozen=True)
class SessionCluster:
    """One for all training processes; or none, where no experiment asks for Ray."""

    address: str | None = None
    """HOST:PORT of its head."""
    shared_out: bool = False
    """It is this machine, whose cores are shared out by the session."""
    cpus: int | None = None
    """Of all its machines; None: the cores of this machine."""
    node_cpus: int | None = None
    """Of its largest machine; None as for `cpus`."""
    learners: bool = False
    """Runs train on it, instead of only their workers."""

    @classmethod
    def open(cls, backends: Sequence[BackendConfig]) -> Self:
        """Connect to the cluster that experiments ask for, or start it. Raises HeadwayError where that
        fails."""
        asking = [backend for backend in backends if backend.name == "ray"]
        if not asking:
            return cls()
        asked, learners = asking[0].address, asking[0].learners
        address = connect(asked)
        if asked == "local":
            return cls(address, shared_out=True, learners=learners == "cluster")
        import ray

        nodes = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
        cpus = int(sum(nodes))
        if cpus == 0:
            disconnect()
            raise HeadwayError(f"the Ray cluster at {address} has no CPUs; start nodes with `ray start`")
        on_it = learners == "cluster" or (learners is None and len(asking) > 1)
        return cls(address, cpus=cpus, node_cpus=int(max(nodes)), learners=on_it)

    def backend(self, asked: BackendConfig) -> BackendConfig:
        """The backend of a training process: on this cluster."""
        if self.address is None or asked.name != "ray":
            return asked
        cpus = 0.0 if asked.worker_cpus is None and self.shared_out else asked.worker_cpus
        return replace(asked, address=self.address, worker_cpus=cpus)

    def share_cores(self, backend: BackendConfig, jobs: Sequence[PlannedJob], cores: int) -> CoreShares:
        """See `headway_launch.runner.jobs.share_cores`; `cores` are this machine's. A run that is placed
        whole takes cores as one on this machine does, and no more than a machine of the cluster has: as
        workers, if it does not say how many it needs, and as a place, if it does."""
        if not self.learners or self.cpus is None:
            return share_cores(backend, jobs, cores, self.cpus)
        return share_cores(backend, jobs, self.cpus, node_cpus=self.node_cpus)

    def open_training(self, job: "TrainingJob") -> Training:
        """Start a training process, here or, with workers beside it as processes, on the cluster."""
        backend = job.config.backend
        if not self.learners or backend.name != "ray":
            return TrainingProcess(job)
        from headway_launch.runner.cluster.ray_training import RayTraining

        whole = replace(job, config=replace(job.config, backend=replace(backend, name="process")))
        return RayTraining(whole, self.node_cpus)

    def close(self) -> None:
        """Disconnect; a cluster that this session started ends."""
        if self.address is not None:
            disconnect()

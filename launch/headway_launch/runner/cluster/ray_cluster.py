"""The Ray cluster that runs a session's rollout workers, or its complete training processes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from headway.config.experiment import BackendConfig
from headway.contracts.errors import HeadwayError
from headway.rollout.workers.ray_cluster import connect, disconnect
from headway_launch.runner.cores import CoreShares, share_cores
from headway_launch.runner.jobs import PlannedJob
from headway_launch.runner.training_process import Training, TrainingProcess

if TYPE_CHECKING:
    from headway.training.loop import TrainingJob


@dataclass(frozen=True)
class SessionCluster:
    """The Ray cluster shared by all training processes of a session; empty if no backend is Ray."""

    address: str | None = None
    """HOST:PORT of the head node; None without a cluster."""
    shared_out: bool = False
    """Whether the cluster is this machine only, so that the session divides the cores itself."""
    cpus: int | None = None
    """CPUs of all nodes; None: use the cores of this machine."""
    node_cpus: int | None = None
    """CPUs of the largest node; None as for `cpus`."""
    gpus: float = 0.0
    """GPUs of all nodes."""
    learners: bool = False
    """Whether complete training processes run on the cluster, not only their rollout workers."""

    @classmethod
    def open(cls, backends: Sequence[BackendConfig]) -> Self:
        """Connect to the cluster that the backends request, or start one on this machine.

        Raises HeadwayError if that fails.
        """
        on_ray = [backend for backend in backends if backend.name == "ray"]
        if not on_ray:
            return cls()
        requested, learners = on_ray[0].address, on_ray[0].learners
        address = connect(requested)
        import ray

        # Read once: Ray does not answer while the cluster's head is gone.
        gpus = ray.cluster_resources().get("GPU", 0.0)
        if requested == "local":
            return cls(address, shared_out=True, gpus=gpus, learners=learners == "cluster")
        nodes = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
        cpus = int(sum(nodes))
        if cpus == 0:
            disconnect()
            raise HeadwayError(f"the Ray cluster at {address} has no CPUs; start nodes with `ray start`")
        learners_on_cluster = learners == "cluster" or (learners is None and len(on_ray) > 1)
        return cls(address, cpus=cpus, node_cpus=int(max(nodes)), gpus=gpus, learners=learners_on_cluster)

    def backend(self, asked: BackendConfig) -> BackendConfig:
        """Return the backend of a training process with the address of this cluster."""
        if self.address is None or asked.name != "ray":
            return asked
        cpus = 0.0 if asked.worker_cpus is None and self.shared_out else asked.worker_cpus
        return replace(asked, address=self.address, worker_cpus=cpus)

    def share_cores(self, backend: BackendConfig, jobs: Sequence[PlannedJob], cores: int) -> CoreShares:
        """Return how the cores are shared, as `headway_launch.runner.cores.share_cores`.

        `cores`: of this machine. Training processes on the cluster take at most the CPUs of one node each.
        """
        if not self.learners or self.cpus is None:
            return share_cores(backend, jobs, cores, self.cpus)
        return share_cores(backend, jobs, self.cpus, node_cpus=self.node_cpus)

    def open_training(self, job: "TrainingJob") -> Training:
        """Start a training process here, or on a cluster node, together with its rollout workers."""
        backend = job.config.backend
        if not self.learners or backend.name != "ray":
            return TrainingProcess(job)
        from headway_launch.runner.cluster.ray_training import RayTraining

        on_node = replace(job, config=replace(job.config, backend=replace(backend, name="process")))
        return RayTraining(on_node, self.node_cpus, self.gpus)

    def close(self) -> None:
        """Disconnect, which ends a cluster that this session started."""
        if self.address is not None:
            disconnect()

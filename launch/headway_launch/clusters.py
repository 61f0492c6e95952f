"""The Ray cluster on which the training processes of one session have their workers."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

from headway.config import BackendConfig
from headway.contracts.errors import HeadwayError
from headway.rollout.cluster import connect, disconnect


@dataclass(frozen=True)
class SessionCluster:
    """One for all training processes; or none, where no experiment asks for Ray."""

    address: str | None = None
    """HOST:PORT of its head."""
    shared_out: bool = False
    """It is this machine, whose cores are shared out by the session."""
    cpus: int | None = None
    """For rollout workers; None: the cores of this machine."""

    @classmethod
    def open(cls, backends: Iterable[BackendConfig]) -> Self:
        """Connect to the cluster that experiments ask for, or start it. Raises HeadwayError where that
        fails."""
        asking = [backend for backend in backends if backend.name == "ray"]
        if not asking:
            return cls()
        asked = asking[0].address
        address = connect(asked)
        if asked == "local":
            return cls(address, shared_out=True)
        import ray

        cpus = int(ray.cluster_resources().get("CPU", 0))
        if cpus == 0:
            disconnect()
            raise HeadwayError(f"the Ray cluster at {address} has no CPUs; start nodes with `ray start`")
        return cls(address, cpus=cpus)

    def backend(self, asked: BackendConfig) -> BackendConfig:
        """The backend of a training process: on this cluster."""
        if self.address is None or asked.name != "ray":
            return asked
        cpus = 0.0 if asked.worker_cpus is None and self.shared_out else asked.worker_cpus
        return replace(asked, address=self.address, worker_cpus=cpus)

    def close(self) -> None:
        """Disconnect; a cluster that this session started ends."""
        if self.address is not None:
            disconnect()

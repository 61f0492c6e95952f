"""Workers as actors of a Ray cluster, on whatever of its machines there is room.

Parameters go through Ray's object store, once an iteration and once a machine, and are read where they lie.
Experience comes back through it, and is copied once, to its place in the trajectory.
"""

import os
import pickle
import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import ray
from numpy.typing import NDArray

from headway.config.experiment import BackendConfig
from headway.contracts import HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway.events import Usage
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.pool_collector import PoolCollector
from headway.rollout.sampler import shard_views
from headway.rollout.workers.ray_cluster import connect, disconnect
from headway.rollout.workers.worker import (
    Collect,
    Command,
    CommandFailed,
    CommandServer,
    Done,
    SamplingService,
    Setup,
)
from headway.rollout.workers.worker_pool import Notify, WorkerConnection

PATIENCE_S = 10.0
"""How long a worker may wait for a place in the cluster before the user is told."""
_SAME_EVERYWHERE = ("headway", "numpy", "numba")
"""Packages whose versions decide what a worker gives."""

_BECAUSE = re.compile(r"because (.+?)\.(?= |$)")
_EXIT_CODE = re.compile(r"exits with an exit code (\d+)")
_REASON_LENGTH = 200

Experience = Mapping[str, NDArray[Any]]


def ray_collector(
    backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
) -> PoolCollector:
    """Actors, one a shard, that are given the parameters and give back the experience of their copies.

    Raises HeadwayError where there is no cluster.
    """
    return PoolCollector(plan, RaySamplingTransport(backend, plan, shards, notify), len(shards), notify)


def pickled_whole(plan: object) -> bytes:
    """A plan pickled with what is defined in the main module, which actors do not have."""
    pickled: bytes = ray.cloudpickle.dumps(plan)
    return pickled


@dataclass(frozen=True)
class ShardSetup:
    """All that an actor is given that samples."""

    plan: bytes
    """A `RolloutPlan`, pickled."""
    shard: Shard
    parameters: dict[str, NDArray[Any]] = field(default_factory=dict)
    """Filled before each command."""

    def open(self) -> SamplingService:
        """The service of an actor that samples, into a trajectory of its own."""
        plan: RolloutPlan = pickle.loads(self.plan)
        ours = plan.of_replicas(self.shard.first_replica, self.shard.replicas)
        trajectory = Trajectory.allocate(replace(ours, copies=self.shard.count).layout)
        return SamplingService(plan, self.shard, trajectory, self.parameters, own=True)


@dataclass(frozen=True)
class Place:
    """Where an actor is, and with what."""

    machine: str
    """The same for processes that share a machine's cores, whatever Ray calls a node."""
    host: str
    process_id: int
    versions: Mapping[str, str]

    @classmethod
    def here(cls) -> "Place":
        """Of this process."""
        booted = Path("/proc/sys/kernel/random/boot_id")
        host = socket.gethostname()
        machine = booted.read_text().strip() if booted.exists() else host
        return cls(machine, host, os.getpid(), dict(_versions()))


def _versions() -> list[tuple[str, str]]:
    installed = dict.fromkeys(_SAME_EVERYWHERE, "")
    for name in installed:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return list(installed.items())


class RayRolloutWorker:
    """What runs in the cluster: a worker as any other, told by Ray's calls instead of a pipe."""

    def __init__(self, setup: bytes) -> None:
        self.setup: Setup = pickle.loads(setup)
        self.serving = CommandServer(self.setup)

    def place(self) -> Place:
        """Where it is."""
        return Place.here()

    def execute(self, told: bytes, parameters: Parameters | None) -> tuple[bytes, Experience | None]:
        """The answer to a command, pickled, and what was experienced, which Ray moves without pickling."""
        command: Command = pickle.loads(told)
        if isinstance(self.setup, ShardSetup) and parameters is not None:
            self.setup.parameters.update(parameters)
        answer = bytes(self.serving.answer(command))
        service = self.serving.service
        if isinstance(command, Collect) and isinstance(service, SamplingService):
            return answer, experience_of(service.trajectory)
        return answer, None


class RayLauncher:
    """A workplace of actors, spread over the cluster's nodes."""

    def __init__(self, backend: BackendConfig, setups: Sequence[Setup], notify: Notify) -> None:
        """Connects to the cluster. Raises HeadwayError where that fails."""
        self.notify, self.here = notify, Place.here()
        self.setups = [pickle.dumps(setup) for setup in setups]
        self.cpus = backend.cpus_per_worker
        self.elsewhere: set[str] = set()
        """Other machines that workers were seen on."""
        self.published: Any = None
        """Ray's reference to the parameters of the moment."""
        connect(backend.address)

    def start(self, shard: int) -> "RayConnection":
        """See `WorkerLauncher`. The actor may have to wait for a place."""
        # Neither is restarted nor repeats a call by itself: it would not know where it stood.
        options = {"max_restarts": 0, "max_task_retries": 0, "scheduling_strategy": "SPREAD"}
        made = ray.remote(RayRolloutWorker).options(num_cpus=self.cpus, **options)
        return RayConnection(self, shard, made.remote(self.setups[shard]))

    def wait(self, waitables: Sequence[Any], timeout_s: float | None) -> list[Any]:
        """See `WorkerLauncher`."""
        ray.wait(waitables, num_returns=1, timeout=timeout_s)
        ready: list[Any] = ray.wait(waitables, num_returns=len(waitables), timeout=0)[0]
        return ready

    def dismiss(self, links: Sequence[WorkerConnection]) -> None:
        """See `WorkerLauncher`; there is no grace, as an actor leaves nothing behind."""
        for link in links:
            link.kill()
        self.published = None
        disconnect()

    def take(self, shard: int, experience: Experience) -> None:
        """Take in what a worker brings besides its answer."""
        raise TypeError(f"worker {shard} brought experience that nobody asked for")

    def check_place(self, shard: int, place: Place) -> None:
        """Look at where a worker has come to be, and with what. Raises HeadwayError where it would not give
        the same as one here."""
        for name, version in self.here.versions.items():
            theirs = place.versions[name]
            if theirs != version:
                raise HeadwayError(
                    f"worker {shard} on {place.host} has {name} {theirs or 'of no known version'}, and this "
                    f"machine {version or 'one of no known version'}; install the same on all machines"
                )
        if place.machine != self.here.machine and place.machine not in self.elsewhere:
            if not self.elsewhere:
                self.notify(
                    f"workers run on other machines, such as {place.host}: the CPU time and energy that they "
                    "use there are not in this run's figures"
                )
            self.elsewhere.add(place.machine)

    def notify_waiting(self, shard: int) -> None:
        """Tell the user that a worker has no place yet."""
        there, free = cpus_of(ray.cluster_resources()), cpus_of(ray.available_resources())
        self.notify(
            f"worker {shard} waits for a place: it asks for {self.cpus:g} CPUs, and of the cluster's "
            f"{there:g} {free:g} are free; it starts as soon as there is room, and fewer backend.workers or "
            "backend.worker_cpus need less"
        )


def cpus_of(resources: Mapping[str, float]) -> float:
    """CPUs among a cluster's resources."""
    return resources.get("CPU", 0.0)


class RaySamplingTransport(RayLauncher):
    """Actors that sample: what they are given and bring goes through the object store."""

    def __init__(
        self, backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
    ) -> None:
        pickled = pickled_whole(plan)
        super().__init__(backend, [ShardSetup(pickled, shard) for shard in shards], notify)
        self.trajectory = Trajectory.allocate(plan.layout)
        self.parts = [shard_views(self.trajectory, plan.replicas, shard) for shard in shards]

    def publish(self, parameters: Parameters) -> None:
        """See `SamplingTransport`."""
        # In C order, as in shared memory: the layout changes how a product is rounded.
        ordered = {name: np.ascontiguousarray(array) for name, array in parameters.items()}
        self.published = ray.put(ordered)

    def take(self, shard: int, experience: Experience) -> None:
        """To its place in the trajectory."""
        place_experience(self.parts[shard], experience)

    def close(self) -> None:
        """See `SamplingTransport`: all is gone with the workers."""


class RayConnection:
    """An actor, and what it was last asked."""

    def __init__(self, launcher: RayLauncher, shard: int, actor: Any) -> None:  # noqa: ANN401 - Ray's handle
        self.launcher, self.shard, self.actor = launcher, shard, actor
        self.arriving = actor.place.remote()
        self.place: Place | None = None
        self.asked: Any = None
        self.lost_with_machine = False
        """See `WorkerConnection`."""

    @property
    def process_id(self) -> int | None:
        """See `WorkerConnection`."""
        if self.place is None or self.place.machine != self.launcher.here.machine:
            return None
        return self.place.process_id

    @property
    def waitable(self) -> Any:  # noqa: ANN401 - Ray's reference
        """See `WorkerConnection`."""
        return self.asked

    def send(self, command: Command) -> None:
        """See `WorkerConnection`."""
        self.asked = self.actor.execute.remote(pickle.dumps(command), self.launcher.published)

    def receive(self) -> Done | CommandFailed | str:
        """See `WorkerConnection`."""
        try:
            self._arrive()
            content, experience = ray.get(self.asked)
        except ray.exceptions.RayError as error:
            self.lost_with_machine = is_loss_of_machine(error)
            return reason_of(error)
        answer: Done | CommandFailed = pickle.loads(content)
        if isinstance(answer, CommandFailed):
            return answer
        if experience is not None:
            self.launcher.take(self.shard, experience)
        # Energy and memory are measured on this machine, and shared out by what was used here.
        return answer if self.process_id is not None else replace(answer, usage=Usage())

    def kill(self) -> None:
        """See `WorkerConnection`."""
        ray.kill(self.actor, no_restart=True)

    def _arrive(self) -> None:
        if self.place is not None:
            return
        if not ray.wait([self.arriving], timeout=PATIENCE_S)[0] and self.launcher.cpus:
            self.launcher.notify_waiting(self.shard)
        place: Place = ray.get(self.arriving)
        self.launcher.check_place(self.shard, place)
        self.place = place


def reason_of(error: Exception) -> str:
    """How an actor was lost, as a part of a line."""
    lines = [line for line in str(error).splitlines() if line.strip() and not line.startswith("\t")]
    if not lines:
        return type(error).__name__
    if "in its creation task" in lines[0]:
        return lines[-1].strip()
    if isinstance(error, ray.exceptions.ActorUnavailableError):
        return "its machine cannot be reached"
    text = " ".join(" ".join(lines).split())
    because, code = _BECAUSE.search(text), _EXIT_CODE.search(text)
    if because is None:
        return f"{type(error).__name__}: {text[:_REASON_LENGTH]}"
    return f"{because[1]}, exit code {code[1]}" if code else because[1]


def is_loss_of_machine(error: Exception) -> bool:
    """Whether it is said, or likely, that an actor, or what it answered, was lost with the machine."""
    lost = (ray.exceptions.ActorUnavailableError, ray.exceptions.ObjectLostError)
    return isinstance(error, lost) or reason_of(error).startswith("its node ")


def experience_of(trajectory: Trajectory) -> Experience:
    """A trajectory's arrays by name; of those that are valid only where an agent's episode ended, these rows
    alone, as most of them would be sent for nothing."""
    arrays = {field_.name: getattr(trajectory, field_.name) for field_ in fields(trajectory)}
    ended = trajectory.terminated | trajectory.truncated
    arrays["final_observations"] = trajectory.final_observations[ended]
    arrays["final_states"] = trajectory.final_states[ended.any(axis=2)]
    return arrays


def place_experience(part: Mapping[str, NDArray[Any]], experience: Experience) -> None:
    """Copy what `experience_of` gave to its part, as `part_of` has it, of a trajectory of all copies."""
    shape = part["terminated"].shape
    ended = (experience["terminated"] | experience["truncated"]).reshape(shape)
    for name, array in part.items():
        if name == "final_observations":
            array[ended] = experience[name]
        elif name == "final_states":
            array[ended.any(axis=-1)] = experience[name]
        else:
            array[...] = experience[name].reshape(array.shape)


def nbytes_of(experience: Experience) -> int:
    """Bytes that are sent of it."""
    return sum(np.asarray(array).nbytes for array in experience.values())

"""Ray workers: rollout workers that run as actors of a Ray cluster, on any machine with free CPUs.

Parameters are sent through Ray's object store, once per iteration and machine, and read there without a copy.
Experience returns through the object store and is copied once, to its place in the trajectory.
"""

import os
import pickle
import re
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
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
from headway.rollout.sampler import shard_views
from headway.rollout.workers.ray_cluster import connect, disconnect
from headway.rollout.workers.worker import (
    Collect,
    Command,
    CommandFailed,
    CommandServer,
    Done,
    WorkerSetup,
)
from headway.rollout.workers.worker_pool import Notify, WorkerConnection

PATIENCE_S = 10.0
"""Seconds that a worker may wait for free CPUs before the user gets a notice."""
_VERSIONED_PACKAGES = ("headway", "numpy", "numba")
"""Packages whose versions affect a worker's results and must agree on all machines."""

_BECAUSE = re.compile(r"because (.+?)\.(?= |$)")
_EXIT_CODE = re.compile(r"exits with an exit code (\d+)")
_REASON_LENGTH = 200

Experience = Mapping[str, NDArray[Any]]


def pickled_whole(plan: object) -> bytes:
    """Return a plan pickled together with its definitions from the main module, which workers lack."""
    pickled: bytes = ray.cloudpickle.dumps(plan)
    return pickled


@dataclass(frozen=True)
class Place:
    """Machine, process and package versions of a Ray worker."""

    machine: str
    """Identifier of the physical machine, which may run several Ray nodes."""
    host: str
    process_id: int
    versions: Mapping[str, str]
    """Installed version by package; empty if unknown."""

    @classmethod
    def here(cls) -> "Place":
        """Return the place of this process."""
        boot_id = Path("/proc/sys/kernel/random/boot_id")
        host = socket.gethostname()
        machine = boot_id.read_text().strip() if boot_id.exists() else host
        return cls(machine, host, os.getpid(), _versions())


def _versions() -> Mapping[str, str]:
    installed = dict.fromkeys(_VERSIONED_PACKAGES, "")
    for name in installed:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return installed


class RayRolloutWorker:
    """A rollout worker on a Ray cluster, which receives commands as remote calls."""

    def __init__(self, setup: bytes) -> None:
        self.setup: WorkerSetup = pickle.loads(setup)
        self.server = CommandServer(self.setup)

    def place(self) -> Place:
        """Return the place of the worker."""
        return Place.here()

    def execute(self, pickled: bytes, parameters: Parameters | None) -> tuple[bytes, Experience | None]:
        """Execute a pickled command; return the pickled answer and, after `Collect`, the experience.

        The experience is returned as arrays, which Ray moves without pickling.
        """
        command: Command = pickle.loads(pickled)
        if parameters is not None:
            self.setup.parameters.update(parameters)
        answer = bytes(self.server.answer(command))
        service = self.server.service
        if isinstance(command, Collect) and service is not None:
            return answer, experience_of(service.trajectory)
        return answer, None


class RayLauncher:
    """Starts Ray workers, spread over the cluster's nodes."""

    def __init__(
        self,
        backend: BackendConfig,
        plan: RolloutPlan,
        shards: Sequence[Shard],
        notify: Notify,
        parts: Sequence[Mapping[str, NDArray[Any]]] = (),
    ) -> None:
        """Connect to the cluster. `parts`: each worker's views of the trajectory, in synchronous training.

        Raises HeadwayError if that fails.
        """
        self.notify, self.here = notify, Place.here()
        pickled = pickled_whole(plan)
        self.setups = [pickle.dumps(WorkerSetup(pickled, shard)) for shard in shards]
        self.parts, self.cpus = parts, backend.cpus_per_worker
        self.other_machines: set[str] = set()
        """Identifiers of other machines that workers run on."""
        self.published: Any = None
        """Ray's reference to the current parameters; None in asynchronous training."""
        connect(backend.address)

    def start(self, shard: int) -> "RayConnection":
        """Start the worker of a shard, which may have to wait for free CPUs."""
        # Ray must neither restart a worker nor repeat a call: the worker's state would be lost.
        options = {"max_restarts": 0, "max_task_retries": 0, "scheduling_strategy": "SPREAD"}
        actor_class = ray.remote(RayRolloutWorker).options(num_cpus=self.cpus, **options)
        return RayConnection(self, shard, actor_class.remote(self.setups[shard]))

    def wait(self, waitables: Sequence[Any], timeout_s: float | None) -> list[Any]:
        """Return the Ray references that are ready, see `WorkerLauncher.wait`."""
        ray.wait(waitables, num_returns=1, timeout=timeout_s)
        ready: list[Any] = ray.wait(waitables, num_returns=len(waitables), timeout=0)[0]
        return ready

    def dismiss(self, links: Sequence[WorkerConnection]) -> None:
        """Kill the workers at once and disconnect."""
        for link in links:
            link.kill()
        self.published = None
        disconnect()

    def check_place(self, shard: int, place: Place) -> None:
        """Raise HeadwayError if a worker's package versions differ from those of this process.

        Notify the user of the first worker on another machine.
        """
        for name, version in self.here.versions.items():
            other = place.versions[name]
            if other != version:
                raise HeadwayError(
                    f"worker {shard} on {place.host} has {name} {other or 'of unknown version'}, and this "
                    f"machine has {version or 'an unknown version'}; install the same on all machines"
                )
        if place.machine != self.here.machine and place.machine not in self.other_machines:
            if not self.other_machines:
                self.notify(
                    f"workers run on other machines, such as {place.host}: their CPU time and energy are "
                    "not included in this run's"
                )
            self.other_machines.add(place.machine)

    def notify_waiting(self, shard: int) -> None:
        """Notify the user that a worker waits for free CPUs."""
        resources = ray.cluster_resources(), ray.available_resources()
        total, free = (each.get("CPU", 0.0) for each in resources)
        self.notify(
            f"worker {shard} waits for free CPUs: it needs {self.cpus:g}, and {free:g} of the cluster's "
            f"{total:g} are free; it starts as soon as there are enough; a lower backend.workers or "
            "backend.worker_cpus needs fewer"
        )


class SamplingRayLauncher(RayLauncher):
    """Starts Ray workers of synchronous training; parameters and experience move through the object store."""

    def __init__(
        self, backend: BackendConfig, plan: RolloutPlan, shards: Sequence[Shard], notify: Notify
    ) -> None:
        """Connect to the cluster. Raises HeadwayError if that fails."""
        self.trajectory = Trajectory.allocate(plan.layout)
        parts = [shard_views(self.trajectory, plan.replicas, shard) for shard in shards]
        super().__init__(backend, plan, shards, notify, parts)

    def publish(self, parameters: Parameters) -> None:
        """Put the parameters into the object store."""
        # In C order, as in shared memory: the layout affects the rounding of matrix products.
        ordered = {name: np.ascontiguousarray(array) for name, array in parameters.items()}
        self.published = ray.put(ordered)


class RayConnection:
    """A Ray worker's handle and the reference to its last answer."""

    def __init__(self, launcher: RayLauncher, shard: int, actor: Any) -> None:  # noqa: ANN401 - Ray's handle
        self.launcher, self.shard, self.actor = launcher, shard, actor
        self.place_reference = actor.place.remote()
        """Ray's reference to the worker's `Place`, ready once the worker has started."""
        self.place: Place | None = None
        """The worker's place; None until its first answer."""
        self.answer_reference: Any = None
        self.lost_with_machine = False
        """The last `receive` found the worker's machine lost or unreachable."""

    @property
    def process_id(self) -> int | None:
        """Id of the worker's process; None before its first answer and on other machines."""
        if self.place is None or self.place.machine != self.launcher.here.machine:
            return None
        return self.place.process_id

    @property
    def waitable(self) -> Any:  # noqa: ANN401 - Ray's reference
        """Ray's reference to the answer."""
        return self.answer_reference

    def await_start(self) -> None:
        """Wait until the worker has started, and check its place, see `RayLauncher.check_place`."""
        with suppress(ray.exceptions.RayError):  # `receive` reports it
            self._wait_for_place()

    def send(self, command: Command) -> None:
        """Call the worker with a command and the current parameters."""
        self.answer_reference = self.actor.execute.remote(pickle.dumps(command), self.launcher.published)

    def receive(self) -> Done | CommandFailed | str:
        """Return the answer, or how the worker was lost."""
        try:
            self._wait_for_place()
            content, experience = ray.get(self.answer_reference)
        except ray.exceptions.RayError as error:
            self.lost_with_machine = is_loss_of_machine(error)
            return reason_of(error)
        answer: Done | CommandFailed = pickle.loads(content)
        if isinstance(answer, CommandFailed):
            return answer
        if experience is not None:
            place_experience(self.launcher.parts[self.shard], experience)
        # Energy is measured on this machine only and divided by the usage on this machine.
        return answer if self.process_id is not None else replace(answer, usage=Usage())

    def kill(self) -> None:
        """Kill the worker."""
        ray.kill(self.actor, no_restart=True)

    def _wait_for_place(self) -> None:
        """Wait until the worker has started, then check its place."""
        if self.place is not None:
            return
        if not ray.wait([self.place_reference], timeout=PATIENCE_S)[0] and self.launcher.cpus:
            self.launcher.notify_waiting(self.shard)
        place: Place = ray.get(self.place_reference)
        self.launcher.check_place(self.shard, place)
        self.place = place


def reason_of(error: Exception) -> str:
    """Return, for messages, how a Ray actor was lost."""
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
    """Return whether an actor or its answer was lost with its machine, certainly or probably."""
    lost = (ray.exceptions.ActorUnavailableError, ray.exceptions.ObjectLostError)
    return isinstance(error, lost) or reason_of(error).startswith("its node ")


def experience_of(trajectory: Trajectory) -> Experience:
    """Return a trajectory's arrays by name, for sending.

    Arrays that are valid only where a stream ended are reduced to these rows, which are few.
    """
    arrays = {field_.name: getattr(trajectory, field_.name) for field_ in fields(trajectory)}
    ended = trajectory.terminated | trajectory.truncated
    arrays["final_observations"] = trajectory.final_observations[ended]
    arrays["final_states"] = trajectory.final_states[ended.any(axis=2)]
    return arrays


def place_experience(part: Mapping[str, NDArray[Any]], experience: Experience) -> None:
    """Copy the result of `experience_of` to a shard's views (see `shard_views`) of the full trajectory."""
    shape = part["terminated"].shape
    ended = (experience["terminated"] | experience["truncated"]).reshape(shape)
    for name, array in part.items():
        if name == "final_observations":
            array[ended] = experience[name]
        elif name == "final_states":
            array[ended.any(axis=-1)] = experience[name]
        else:
            array[...] = experience[name].reshape(array.shape)

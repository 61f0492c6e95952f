"""One training process somewhere in a Ray cluster, as its session sees it: a twin of `TrainingProcess`.

It has its rollout workers beside it, as processes of its machine, and writes its run folders itself, so these
must lie on a file system that all machines share.
"""

import pickle
import queue
import threading
from dataclasses import dataclass, replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import ray

from headway.events import (
    EvaluationFinished,
    Event,
    Failed,
    Finished,
    IterationFinished,
    Notice,
    Started,
    Usage,
)
from headway.rollout.workers.ray_workers import PATIENCE_S, Place, pickled_whole, reason_of
from headway.training.loop import TrainingJob
from headway_launch.console.output import print_line
from headway_launch.console.threads import ONE_THREAD
from headway_launch.runner.jobs import cores_taken, gpus_of
from headway_launch.runner.training_process import train_and_tell

_WAIT_S = 1.0


class TrainingHost:
    """What runs in the cluster."""

    def __init__(self) -> None:
        self.events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self.stop = threading.Event()

    def place(self) -> Place:
        """Where it is."""
        return Place.here()

    def train(self, pickled: bytes) -> None:
        """Train the job; what happens is told by `next_events`."""
        try:
            job: TrainingJob = pickle.loads(pickled)
            missing = [folder for folder in job.directories if not Path(folder).is_dir()]
            if missing:
                line = (
                    f"{Place.here().host} has no folder {missing[0]}: a sweep over a cluster needs "
                    "store.root on a file system that all machines share, or backend.learners=here"
                )
                self.events.put(Failed(line, ""))
                return
            train_and_tell(job, self._tell, self.stop.is_set)
        except Exception as error:
            self.events.put(Failed(f"{type(error).__name__}: {error}".splitlines()[0], ""))
        finally:
            self.events.put(None)

    def _tell(self, event: Event) -> None:
        """A failure also to Ray's log on this machine: its session may have lost it, and hear nothing."""
        if isinstance(event, Failed):
            print_line(f"headway: {event.line}")
        self.events.put(event)

    def next_events(self) -> list[Event | None]:
        """What has happened since the last call, after a moment where that is nothing; None: all is told."""
        found: list[Event | None] = []
        try:
            found.append(self.events.get(timeout=_WAIT_S))
            while True:
                found.append(self.events.get_nowait())
        except queue.Empty:
            return found

    def ask_to_stop(self) -> None:
        """Ask for a checkpoint and an end."""
        self.stop.set()


@dataclass(frozen=True)
class Placement:
    """What a training process asks of the cluster."""

    cpus: float
    gpus: float = 0.0

    @classmethod
    def of(cls, job: TrainingJob, node_cpus: int | None, there: float) -> "Placement":
        """CPUs as `cores_taken` says, at most `node_cpus`, those of the largest node; where that is None, on
        this machine, whose cores are shared out already, none. A GPU where it trains on one, if so many are
        `there`."""
        taken, block = 0, job.config.rollout.block
        if node_cpus is not None:
            taken = cores_taken(job.spec, len(job.seeds), block, job.workers, node_cpus)
        return cls(float(taken), gpus_of(job.config.device, there))


class RayTraining:
    """See `headway_launch.runner.scheduler.Training`."""

    def __init__(self, job: TrainingJob, node_cpus: int | None) -> None:
        """`node_cpus`: see `Placement.of`."""
        asks = Placement.of(job, node_cpus, ray.cluster_resources().get("GPU", 0.0))
        made = ray.remote(TrainingHost).options(
            num_cpus=asks.cpus,
            num_gpus=asks.gpus,
            runtime_env={"env_vars": ONE_THREAD},
            scheduling_strategy="SPREAD",
            max_restarts=0,
            max_task_retries=0,
            max_concurrency=4,  # one trains, the others answer
        )
        self._asks, self._host = asks, made.remote()
        self._events, self._told = Pipe(duplex=False)
        self._at_end = False
        self._how = ""
        self.lost = False
        self._relay = threading.Thread(target=self._pass_on, args=(pickled_whole(job),), daemon=True)
        self._relay.start()

    @property
    def connection(self) -> Connection:
        """See `Training`."""
        return self._events

    @property
    def sentinel(self) -> Connection:
        """See `Training`: what is heard ends with it."""
        return self._events

    def has_event(self) -> bool:
        """See `Training`."""
        return not self._at_end and self._events.poll()

    def has_ended(self) -> bool:
        """See `Training`."""
        return self._at_end

    def receive(self) -> Event | None:
        """See `Training`."""
        try:
            event: Event = self._events.recv()
        except (EOFError, OSError):
            self._at_end = True
            return None
        return event

    def ask_to_stop(self) -> None:
        """See `Training`."""
        self._host.ask_to_stop.remote()

    def kill(self) -> None:
        """See `Training`."""
        ray.kill(self._host, no_restart=True)

    def join(self) -> str:
        """See `Training`."""
        self._relay.join()
        self.kill()
        self._events.close()
        return self._how or "its training process ended with no word"

    def _pass_on(self, job: bytes) -> None:
        """In a thread of its own: hand to the session what the training process tells."""
        try:
            here = Place.here()
            arriving = self._host.place.remote()
            if not ray.wait([arriving], timeout=PATIENCE_S)[0] and self._asks.cpus:
                self._told.send(Notice(f"waits for a place in the cluster with {self._asks.cpus:g} CPUs"))
            elsewhere = ray.get(arriving).machine != here.machine
            self._host.train.remote(job)
            while True:
                for event in ray.get(self._host.next_events.remote()):
                    if event is None:
                        return
                    self._told.send(without_usage(event) if elsewhere else event)
        except ray.exceptions.RayError as error:
            self.lost, self._how = True, f"its training process was lost ({reason_of(error)})"
        except OSError:
            return  # the session listens no more
        finally:
            self._told.close()


def without_usage(event: Event) -> Event:
    """An event of another machine: the CPU time and memory used there are not this one's, whose energy is
    shared out by them."""
    match event:
        case Started():
            return replace(event, process_ids=())
        case IterationFinished() | EvaluationFinished() | Finished():
            return replace(event, usage=Usage())
        case _:
            return event

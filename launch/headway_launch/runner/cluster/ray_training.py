"""A training process on a node of a Ray cluster.

Its rollout workers are processes of the same node. It writes its run folders itself, so the store must be on
a file system that all nodes share.
"""

import pickle
import queue
import threading
import time
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path

import ray

from headway.contracts.errors import one_line
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
from headway_launch.runner.cores import cores_taken, gpus_of
from headway_launch.runner.training_process import Training, train_and_report

_WAIT_S = 1.0


class TrainingHost:
    """Ray worker that runs one training process on a node of the cluster."""

    def __init__(self) -> None:
        self.events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self.stop = threading.Event()

    def place(self) -> Place:
        """Return host, process and versions of this Ray worker."""
        return Place.here()

    def train(self, pickled: bytes) -> None:
        """Train the job; `next_events` returns its events."""
        try:
            job: TrainingJob = pickle.loads(pickled)
            missing = [folder for folder in job.directories if not Path(folder).is_dir()]
            if missing:
                line = (
                    f"{Place.here().host} has no folder {missing[0]}: a sweep over a cluster needs "
                    "store.root on a file system that all nodes share, or backend.learners=here"
                )
                self.events.put(Failed(line, ""))
                return
            train_and_report(job, self._put, self.stop.is_set)
        except Exception as error:
            self.events.put(Failed(one_line(error), ""))
        finally:
            self.events.put(None)

    def _put(self, event: Event) -> None:
        """Queue an event for the session."""
        if isinstance(event, Failed):
            # Also to Ray's log on this node: the session may have lost the connection.
            print_line(f"headway: {event.line}")
        self.events.put(event)

    def next_events(self) -> list[Event | None]:
        """Return the events since the last call, after waiting up to `_WAIT_S`; None marks the end."""
        found: list[Event | None] = []
        try:
            found.append(self.events.get(timeout=_WAIT_S))
            while True:
                found.append(self.events.get_nowait())
        except queue.Empty:
            return found

    def ask_to_stop(self) -> None:
        """Request a checkpoint and an orderly end."""
        self.stop.set()


def cpus_for(job: TrainingJob, node_cpus: int | None) -> float:
    """Return the CPUs that a training process requests from the cluster, as `cores_taken` counts them.

    `node_cpus`: CPUs of the largest node, an upper limit; None: request none, because the cluster is this
    machine and the session divides its cores.
    """
    return 0.0 if node_cpus is None else float(cores_taken(job, job.workers, node_cpus))


class RayTraining(Training):
    """The session's handle of a `TrainingHost`."""

    def __init__(self, job: TrainingJob, node_cpus: int | None, cluster_gpus: float) -> None:
        """Start training on the first node that has the resources: see `cpus_for` and `gpus_of`."""
        self._cpus = cpus_for(job, node_cpus)
        host = ray.remote(TrainingHost).options(
            num_cpus=self._cpus,
            num_gpus=gpus_of(job.config.device, cluster_gpus),
            runtime_env={"env_vars": ONE_THREAD},
            scheduling_strategy="SPREAD",
            max_restarts=0,
            max_task_retries=0,
            max_concurrency=4,  # `train` takes one, the other calls the rest
        )
        self._host = host.remote()
        events, self._sender = Pipe(duplex=False)
        super().__init__(events)
        self._end_reason = ""
        self._stop = threading.Event()
        self._relay = threading.Thread(target=self._forward_events, args=(pickled_whole(job),), daemon=True)
        self._relay.start()

    def ask_to_stop(self) -> None:
        """Request a checkpoint and an orderly end; without a node yet it ends at once."""
        self._stop.set()
        self._host.ask_to_stop.remote()

    def kill(self) -> None:
        # In a thread: the call does not return while the cluster's head is gone.
        killing = threading.Thread(
            target=ray.kill, args=(self._host,), kwargs={"no_restart": True}, daemon=True
        )
        killing.start()
        killing.join(_WAIT_S)

    def join(self) -> str:
        self._relay.join()
        self.kill()
        self._events.close()
        return self._end_reason or "its training process ended without a final event"

    def _forward_events(self, job: bytes) -> None:
        """Start training and forward its events to the session; runs in a thread."""
        try:
            arriving = self._host.place.remote()
            if not self._has_node(arriving):
                self.lost, self._end_reason = True, "it had no node of the cluster yet"
                return
            elsewhere = ray.get(arriving).machine != Place.here().machine
            self._host.train.remote(job)
            while True:
                for event in ray.get(self._host.next_events.remote()):
                    if event is None:
                        return
                    self._sender.send(without_usage(event) if elsewhere else event)
        except ray.exceptions.RayError as error:
            self.lost, self._end_reason = True, f"its training process was lost ({reason_of(error)})"
        except OSError:
            return  # the session has closed its end
        finally:
            self._sender.close()

    def _has_node(self, arriving: "ray.ObjectRef[Place]") -> bool:
        """Wait until the host runs on a node; return False if a stop is requested before."""
        noticed = not self._cpus
        began = time.monotonic()
        while not ray.wait([arriving], timeout=_WAIT_S)[0]:
            if self._stop.is_set():
                return False
            if not noticed and time.monotonic() - began > PATIENCE_S:
                line = f"waiting for a node of the cluster with {self._cpus:g} free CPUs"
                self._sender.send(Notice(line))
                noticed = True
        return True


def without_usage(event: Event) -> Event:
    """Return an event from another machine without its resource use.

    The session divides the energy of its own machine only, by the use of that machine.
    """
    match event:
        case Started():
            return replace(event, process_ids=())
        case IterationFinished() | EvaluationFinished() | Finished():
            return replace(event, usage=Usage())
        case _:
            return event

"""A pool of workers on any launcher: sends commands, receives answers, replaces workers that fail."""

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, Protocol

from headway.contracts import HeadwayError
from headway.contracts.errors import WorkersLostError
from headway.events import Usage
from headway.rollout.plan import restart_purpose
from headway.rollout.workers.usage import cpu_seconds_of
from headway.rollout.workers.worker import (
    Begin,
    Collect,
    Command,
    CommandFailed,
    Contribute,
    Done,
    Evaluate,
    Restore,
)
from headway.timeouts import MIN_TIMEOUT_S, START_TIMEOUT_S, AdaptiveTimeout

Notify = Callable[[str], None]


class WorkerConnection(Protocol):
    """The connection to one worker."""

    @property
    def process_id(self) -> int | None:
        """Id of the worker's process; None if it is on another machine."""
        ...

    @property
    def lost_with_machine(self) -> bool:
        """The last `receive` found the worker's machine lost or unreachable."""
        ...

    @property
    def waitable(self) -> Any:  # noqa: ANN401 - a pipe, or another type that the launcher waits for
        """Handle for `WorkerLauncher.wait`, ready once the worker has answered or died."""
        ...

    def await_start(self) -> None:
        """Wait until the worker runs: it may wait for free CPUs. If it is lost, `receive` reports it."""
        ...

    def send(self, command: Command) -> None:
        """Send a command. If the worker is dead, the next `receive` reports it."""
        ...

    def receive(self) -> Done | CommandFailed | str:
        """Wait for the answer and return it, or return the reason of the worker's death."""
        ...

    def kill(self) -> None:
        """End the worker at once."""
        ...


class WorkerLauncher(Protocol):
    """Starts workers, as processes of this machine or as Ray workers of a cluster."""

    def start(self, shard: int) -> WorkerConnection:
        """Start the worker of a shard."""
        ...

    def wait(self, waitables: Sequence[Any], timeout_s: float | None) -> list[Any]:
        """Return the handles that are ready: at least one, or none after the timeout. `timeout_s` None: no
        timeout."""
        ...

    def dismiss(self, links: Sequence[WorkerConnection]) -> None:
        """End the workers, possibly after a grace period of some seconds, and release their resources."""
        ...


_MAX_LOST_MACHINES = 3
"""Lost machines in a row after which a worker is still replaced. Until a loss is known to the whole cluster,
a replacement may be placed on the same machine."""


@dataclass
class _Worker:
    """A worker's connection and last known state."""

    link: WorkerConnection
    begun: bool = False
    """Its episodes have started."""
    has_answered: bool = False
    """It, or a worker before it, has executed a command."""
    snapshot: Any = None
    """State after the last command other than an evaluation."""
    usage: Usage = field(default_factory=Usage)
    pending: list[Command] = field(default_factory=list)
    """Commands not yet answered; the first is in progress. A replacement's begin with the one that restores
    its state. Empty: idle."""
    failures: int = 0
    """Failures of the workers that it replaced since the last executed command, except lost machines."""
    lost_machines: int = 0
    """Lost machines of the workers that it replaced since the last executed command."""
    sent_at: float = 0.0
    """Time of sending the command in progress, s (`time.monotonic`)."""
    is_noticed: bool = False
    """The user has been told that its answer is late: its time limit is far off or unknown."""

    def send(self, *commands: Command) -> None:
        """Send the first of the commands to execute."""
        self.pending = list(commands)
        self.sent_at, self.is_noticed = time.monotonic(), False
        self.link.send(commands[0])

    @property
    def command(self) -> Command:
        """Command in progress."""
        return self.pending[0]

    @property
    def waited_s(self) -> float:
        """Seconds since the command in progress was sent."""
        return time.monotonic() - self.sent_at

    def update(self, done: Done) -> None:
        """Update the state from the answer to the command in progress."""
        self.raise_cpu_seconds(done.usage.cpu_seconds)
        self.has_answered = True
        self.usage = replace(done.usage, cpu_seconds=self.usage.cpu_seconds)
        if not isinstance(self.pending.pop(0), Evaluate):
            self.begun, self.snapshot = True, done.snapshot

    def raise_cpu_seconds(self, cpu_seconds: float) -> None:
        """Update the CPU seconds; they never decrease, although two sources measure them."""
        self.usage = replace(self.usage, cpu_seconds=max(self.usage.cpu_seconds, cpu_seconds))


class WorkerPool:
    """Workers, one per shard, that execute commands and are replaced when they fail or do not answer."""

    def __init__(
        self,
        launcher: WorkerLauncher,
        number: int,
        notify: Notify,
        environment: str = "the environment",
        timeout_s: float | None = None,
    ) -> None:
        """`environment`: its name, for notices. `timeout_s`: `BackendConfig.worker_timeout_s`."""
        self.launcher, self.notify, self.environment = launcher, notify, environment
        self.timeouts: dict[type[Command], AdaptiveTimeout] = {
            kind: AdaptiveTimeout(timeout_s) for kind in (Collect, Evaluate, Contribute)
        }
        """Limits on commands that step environments."""
        self.start_timeout_s = START_TIMEOUT_S if timeout_s is None else max(MIN_TIMEOUT_S, 10 * timeout_s)
        """Limit on making or restoring environments."""
        self.lost_cpu_seconds = 0.0
        """CPU seconds of workers that were replaced."""
        self.restart_purpose = restart_purpose(0)
        """Seed purpose of the episodes that a replacement starts if it has no snapshot."""
        self.unfinished: Collection[int] = ()
        """Workers whose commands may stay unanswered: their CPU time counts; `close` kills them at once."""
        self.workers: list[_Worker] = []
        try:
            for shard in range(number):
                self.workers.append(_Worker(launcher.start(shard)))
        except BaseException:
            self.close()
            raise

    def all(self, commands: Sequence[Command]) -> list[Done]:
        """Execute one command per worker in parallel, in the order of the shards."""
        for shard, command in enumerate(commands):
            self.send(shard, command)
        return [self.answer(shard) for shard in range(len(commands))]

    def send(self, shard: int, command: Command) -> None:
        """Send a command to one worker."""
        self.workers[shard].send(command)

    def answered(self, shards: Sequence[int], timeout_s: float | None) -> list[int]:
        """Return which of the workers, all busy, have answered, died or taken too long, in order.

        At least one, or none after the timeout; None: no timeout.
        """
        waitables = {self.workers[shard].link.waitable: shard for shard in shards}
        until = inf if timeout_s is None else time.monotonic() + timeout_s
        while True:
            # A limit or a notice may fall due before any answer arrives.
            left = min([until - time.monotonic(), *map(self._notice_in_s, shards)])
            wait_s = None if left == inf else max(left, 0)
            found = {waitables[ready] for ready in self.launcher.wait(list(waitables), wait_s)}
            found |= {shard for shard in shards if self._is_overdue(shard)}
            if found or time.monotonic() >= until:
                return sorted(found)

    def _is_overdue(self, shard: int) -> bool:
        """Return whether a worker has exceeded its limit; notify the user of a late worker with a distant
        limit."""
        worker = self.workers[shard]
        limit, waited = self._limit_s(worker), worker.waited_s
        if MIN_TIMEOUT_S <= waited < limit and self._is_notice_due(worker):
            worker.is_noticed = True
            doing = self._doing(worker.command)
            endless = ", or an episode does not end" if isinstance(worker.command, Evaluate) else ""
            self.notify(
                f"worker {shard} has not answered for {waited:.0f} s while {doing}; it may hang{endless}"
            )
        return waited >= limit

    def _limit_s(self, worker: _Worker) -> float:
        """Return how long a worker may take for its command, s; infinity if that is not known.

        A replacement has twice the time, in case the first was only slow.
        """
        starts = self._makes_environments(worker)
        limit = self.start_timeout_s if starts else self.timeouts[type(worker.command)].limit_s
        return limit * (2.0 if worker.failures else 1.0)

    def _makes_environments(self, worker: _Worker) -> bool:
        """Return whether a worker makes or restores its environments, possibly before it steps them."""
        return type(worker.command) not in self.timeouts or not (worker.has_answered or worker.failures)

    def _is_notice_due(self, worker: _Worker) -> bool:
        """Return whether the user is told if a worker is late, because its limit is far off or unknown."""
        return not worker.is_noticed and (self._limit_s(worker) == inf or self._makes_environments(worker))

    def _notice_in_s(self, shard: int) -> float:
        """Return the seconds until a worker is overdue or a notice of it is due."""
        worker = self.workers[shard]
        limit = min(self._limit_s(worker), MIN_TIMEOUT_S if self._is_notice_due(worker) else inf)
        return limit - worker.waited_s

    def _doing(self, command: Command) -> str:
        """Return a description of what a worker does, for notices."""
        match command:
            case Begin():
                return f"starting episodes of {self.environment}"
            case Restore():
                return f"restoring {self.environment}"
            case Collect(iteration=iteration):
                return f"stepping {self.environment} in iteration {iteration}"
            case Evaluate():
                return f"evaluating on {self.environment}"
            case Contribute(number=number):
                return f"stepping {self.environment} for contribution {number}"

    def process_ids(self) -> list[int]:
        """Return the ids of the worker processes on this machine."""
        ids = [worker.link.process_id for worker in self.workers]
        return [process_id for process_id in ids if process_id is not None]

    def usage(self) -> Usage:
        """Return the usage that the workers reported last, with the present CPU time of the `unfinished`."""
        for shard in self.unfinished:
            process_id = self.workers[shard].link.process_id
            if process_id is not None:
                self.workers[shard].raise_cpu_seconds(cpu_seconds_of(process_id))
        return sum((worker.usage for worker in self.workers), Usage(self.lost_cpu_seconds))

    def close(self) -> None:
        """End the workers: those `unfinished` at once, others that are busy after a grace period."""
        for shard in self.unfinished:
            self.workers[shard].link.kill()
        self.launcher.dismiss([worker.link for worker in self.workers])

    def answer(self, shard: int) -> Done:
        """Wait for the answer to the command that was sent; replace the worker if it fails.

        Raises HeadwayError for a user error, and WorkerFailedError if the replacement fails too.
        """
        while (done := self.receive(shard)) is None:
            pass
        return done

    def receive(self, shard: int) -> Done | None:
        """Return the answer, or None while a replacement worker has still to repeat commands.

        Errors are those of `answer`.
        """
        worker = self.workers[shard]
        answer = self._answer_of(shard)
        if isinstance(answer, Done):
            worker.update(answer)
            if not worker.pending:
                worker.failures = worker.lost_machines = 0
                return answer
            worker.send(*worker.pending)
            return None
        if isinstance(answer, CommandFailed) and answer.is_user_error:
            raise HeadwayError(answer.line)
        self._require_replaceable(shard, answer)
        self._replace(shard, answer)
        return None

    def _answer_of(self, shard: int) -> Done | CommandFailed | str:
        """Wait for a worker's answer; return it, or how the worker was lost."""
        worker, began = self.workers[shard], time.monotonic()
        link, command = worker.link, worker.command
        link.await_start()
        # Waiting for free CPUs does not count towards the command's limit.
        worker.sent_at += time.monotonic() - began
        self.answered([shard], None)
        # An answer that arrives at the last moment still counts.
        if self._is_overdue(shard) and not self.launcher.wait([link.waitable], 0):
            slow = "if it is only slow, set a higher backend.worker_timeout_s"
            return f"no answer for {self._limit_s(worker):.0f} s while {self._doing(command)}; {slow}"
        answer = link.receive()
        if isinstance(answer, Done) and type(command) in self.timeouts:
            self.timeouts[type(command)].add(answer.seconds)
        return answer

    def _require_replaceable(self, shard: int, answer: CommandFailed | str) -> None:
        worker, no_traceback = self.workers[shard], "the worker left no traceback"
        # A lost machine is no fault of the worker's code, so it is tolerated more often.
        if worker.link.lost_with_machine:
            if worker.lost_machines == _MAX_LOST_MACHINES:
                times = f"{_MAX_LOST_MACHINES + 1} times in a row"
                raise WorkerFailedError(f"worker {shard} lost its machine {times} ({answer})", no_traceback)
        elif worker.failures:
            if isinstance(answer, CommandFailed):
                raise WorkerFailedError(f"worker {shard} failed twice: {answer.line}", answer.traceback)
            raise WorkerFailedError(f"worker {shard} failed twice ({answer})", no_traceback)

    def _replace(self, shard: int, answer: CommandFailed | str) -> None:
        """Replace a worker that failed; its replacement repeats the command from the last snapshot."""
        reason = answer.line if isinstance(answer, CommandFailed) else answer
        old = self.workers[shard]
        old.link.kill()
        self.lost_cpu_seconds += old.usage.cpu_seconds
        worker = self.workers[shard] = _Worker(self.launcher.start(shard))
        # Kept for a checkpoint that is written while the replacement still repeats the command.
        worker.begun, worker.snapshot = old.begun, old.snapshot
        lost = old.link.lost_with_machine
        worker.failures, worker.lost_machines = old.failures + (not lost), old.lost_machines + lost
        commands = [old.pending[-1]]
        # An evaluation before the first episodes needs no state; Begin and Restore set it themselves.
        if not isinstance(commands[0], Begin | Restore) and old.begun:
            commands.insert(0, resume_command(old.snapshot, self.restart_purpose))
        restarts = any(isinstance(step, Begin) for step in commands)
        consequence = "its episodes start again" if restarts else "repeating its part from the last snapshot"
        self.notify(f"worker {shard} failed ({reason}); replaced, {consequence}")
        worker.send(*commands)


class WorkerFailedError(WorkersLostError):
    """A worker failed twice in a row or lost its machine too often; `details` is its traceback."""


def resume_command(snapshot: Any, purpose: str) -> Command:  # noqa: ANN401 - opaque
    """Return the command to restore a snapshot or, without one, to start episodes with seeds of `purpose`."""
    return Begin(purpose) if snapshot is None else Restore(snapshot)

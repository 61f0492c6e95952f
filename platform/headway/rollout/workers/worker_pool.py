"""Workers of one job, wherever they are: told what to do, heard, and replaced when they fail."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from headway.contracts import HeadwayError
from headway.events import Usage
from headway.rollout.collector import restart_purpose
from headway.rollout.workers.usage import cpu_seconds_of
from headway.rollout.workers.worker import Begin, CommandFailed, Command, Done, Evaluate, Restore

Notify = Callable[[str], None]


class WorkerConnection(Protocol):
    """A worker as it is reached from here."""

    @property
    def process_id(self) -> int | None:
        """Of its process; None where that is on another machine."""
        ...

    @property
    def lost_with_machine(self) -> bool:
        """What `receive` said last is that its machine was lost, or cannot be reached."""
        ...

    @property
    def waitable(self) -> Any:  # noqa: ANN401 - a pipe, or whatever else a workplace waits for
        """Ready, for `WorkerLauncher.wait`, once it has answered or died."""
        ...

    def send(self, command: Command) -> None:
        """Have it begin with a command; that it is dead, `receive` says."""
        ...

    def receive(self) -> Done | CommandFailed | str:
        """Its answer, waited for, or a line that says how it died."""
        ...

    def kill(self) -> None:
        """End it at once."""
        ...


class WorkerLauncher(Protocol):
    """Where workers are: processes of this machine, or actors of a cluster."""

    def start(self, shard: int) -> WorkerConnection:
        """Start the worker of that number."""
        ...

    def wait(self, waitables: Sequence[Any], timeout_s: float | None) -> list[Any]:
        """Those that are ready, at least one unless the time is over; None: however long that takes."""
        ...

    def dismiss(self, links: Sequence[WorkerConnection]) -> None:
        """End workers, which may have some seconds to finish what they do, and give up all that they
        held."""
        ...


_LOST_MACHINES = 3
"""How often in a row the machine under a worker may be lost: until that is known in the whole cluster, a new
worker may be sent to the same one."""


@dataclass
class _Worker:
    """A worker and what is known of it."""

    link: WorkerConnection
    begun: bool = False
    """Its episodes have started."""
    snapshot: Any = None
    """Where it stood after its last command that moved it."""
    usage: Usage = field(default_factory=Usage)
    repeats: list[Command] = field(default_factory=list)
    """What it has yet to carry out in place of one that failed; the first is under way."""
    failures: int = 0
    """Failures of those before it since a command was last carried out, losses of machines aside."""
    lost_machines: int = 0
    """Machines under those before it that were lost since then."""

    def remember(self, command: Command, done: Done) -> None:
        """Note what it says of itself after a command."""
        self.note_cpu_seconds(done.usage.cpu_seconds)
        self.usage = replace(done.usage, cpu_seconds=self.usage.cpu_seconds)
        if not isinstance(command, Evaluate):
            self.begun, self.snapshot = True, done.snapshot

    def note_cpu_seconds(self, cpu_seconds: float) -> None:
        """What it has used as somebody sees it: never less than before."""
        self.usage = replace(self.usage, cpu_seconds=max(self.usage.cpu_seconds, cpu_seconds))


class WorkerPool:
    """Workers, each with a part of its own, that carry out commands and are replaced when they die."""

    def __init__(self, launcher: WorkerLauncher, number: int, notify: Notify) -> None:
        self.launcher, self.notify = launcher, notify
        self.lost_cpu_seconds = 0.0
        self.restart_purpose = restart_purpose(0)
        """Purpose of the seeds of episodes that start anew because their worker died."""
        self.workers: list[_Worker] = []
        try:
            for shard in range(number):
                self.workers.append(_Worker(launcher.start(shard)))
        except BaseException:
            self.close()
            raise

    def all(self, commands: Sequence[Command]) -> list[Done]:
        """Have workers 0, 1, ... carry out one command each, at the same time."""
        for shard, command in enumerate(commands):
            self.send(shard, command)
        return [self.answer(shard, command) for shard, command in enumerate(commands)]

    def send(self, shard: int, command: Command) -> None:
        """Have one worker begin with a command."""
        self.workers[shard].link.send(command)

    def answered(self, shards: Sequence[int], timeout_s: float | None) -> list[int]:
        """Those of some workers that have answered or died, in order; see `WorkerLauncher.wait`."""
        waitables = {self.workers[shard].link.waitable: shard for shard in shards}
        return sorted(waitables[ready] for ready in self.launcher.wait(list(waitables), timeout_s))

    def process_ids(self) -> list[int]:
        """Worker processes of this machine, by id."""
        ids = [worker.link.process_id for worker in self.workers]
        return [process_id for process_id in ids if process_id is not None]

    def usage(self, busy: Iterable[int] = ()) -> Usage:
        """As the workers last reported; of busy ones, the CPU seconds of this moment."""
        for shard in busy:
            process_id = self.workers[shard].link.process_id
            if process_id is not None:
                self.workers[shard].note_cpu_seconds(cpu_seconds_of(process_id))
        return sum((worker.usage for worker in self.workers), Usage(self.lost_cpu_seconds))

    def close(self, hastily: Iterable[int] = ()) -> None:
        """End the workers, busy ones after some seconds of grace, or at once."""
        for shard in hastily:
            self.workers[shard].link.kill()
        self.launcher.dismiss([worker.link for worker in self.workers])

    def answer(self, shard: int, command: Command) -> Done:
        """Of a worker that was sent this command, or of the one that replaces it."""
        while (done := self.receive(shard, command)) is None:
            pass
        return done

    def receive(self, shard: int, command: Command) -> Done | None:
        """The same; or None as soon as the worker is found to have failed, and again when the one that
        replaces it has still something to do."""
        worker = self.workers[shard]
        answer = worker.link.receive()
        if isinstance(answer, Done):
            worker.remember(worker.repeats.pop(0) if worker.repeats else command, answer)
            if not worker.repeats:
                worker.failures = worker.lost_machines = 0
                return answer
            worker.link.send(worker.repeats[0])
            return None
        if isinstance(answer, CommandFailed) and answer.is_user_error:
            raise HeadwayError(answer.line)
        self._require_replaceable(shard, answer)
        self._replace(shard, command, answer)
        return None

    def _require_replaceable(self, shard: int, answer: CommandFailed | str) -> None:
        worker, untraced = self.workers[shard], "the worker left no traceback"
        if worker.link.lost_with_machine:
            if worker.lost_machines == _LOST_MACHINES:
                times = f"{_LOST_MACHINES + 1} times in a row"
                raise WorkerFailedError(f"worker {shard} lost its machine {times} ({answer})", untraced)
        elif worker.failures:
            if isinstance(answer, CommandFailed):
                raise WorkerFailedError(f"worker {shard} failed twice: {answer.line}", answer.traceback)
            raise WorkerFailedError(f"worker {shard} failed twice ({answer})", untraced)

    def _replace(self, shard: int, command: Command, first: CommandFailed | str) -> None:
        """Replace a worker that failed, and have its command repeated from where it stood."""
        reason = first.line if isinstance(first, CommandFailed) else first
        old = self.workers[shard]
        old.link.kill()
        self.lost_cpu_seconds += old.usage.cpu_seconds
        worker = self.workers[shard] = _Worker(self.launcher.start(shard))
        # Where the repetition begins: a checkpoint may be written before it is over.
        worker.begun, worker.snapshot = old.begun, old.snapshot
        lost = old.link.lost_with_machine
        worker.failures, worker.lost_machines = old.failures + (not lost), old.lost_machines + lost
        worker.repeats = [command]
        # Evaluation before the first episodes, or Begin itself, has nothing to go back to.
        if not isinstance(command, Begin | Restore) and old.begun:
            worker.repeats.insert(0, resume_command(old.snapshot, self.restart_purpose))
        restart_purpose = any(isinstance(step, Begin) for step in worker.repeats)
        again = "its episodes start again" if restart_purpose else "repeating its part from where it stood"
        self.notify(f"worker {shard} failed ({reason}); replaced, {again}")
        worker.link.send(worker.repeats[0])


class WorkerFailedError(HeadwayError):
    """A worker failed twice in a row, or lost its machine too often; the details are its own traceback."""


def resume_command(snapshot: Any, restart_purpose: str) -> Command:  # noqa: ANN401 - opaque
    """Bring a worker to where a snapshot stands, or to new episodes, of seeds of the purpose `anew`, where
    there is none."""
    return Begin(restart_purpose) if snapshot is None else Restore(snapshot)

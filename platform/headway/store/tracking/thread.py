"""Background thread that sends a session's updates to MLflow, and retries while MLflow does not respond."""

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from headway.contracts import HeadwayError
from headway.store.tracking.client import Tracker, TrackingError, require_answer, without_password

_RETRY_SECONDS = 30.0
_CONNECT_SECONDS = 120.0


@dataclass(frozen=True)
class TrackingTask:
    """One update for MLflow."""

    send: Callable[[Tracker], object]
    on_failure: Callable[[], object]
    """Called if `send` fails or is skipped."""
    catch_up: Callable[[Tracker], object]
    """Called after a failure, once MLflow responds again: sends everything that is missing."""


class TrackingThread:
    """Runs tracking tasks in order in a background thread.

    While MLflow fails, tasks are deferred: one notice says so, and the thread retries at intervals and at the
    end. A task that fails for another reason, such as an unreadable run, gives one notice and is skipped. No
    failure ends the session.
    """

    def __init__(self, root: Path, tracking_uri: str | None) -> None:
        self._root, self._uri = root, tracking_uri
        self._tasks: queue.SimpleQueue[TrackingTask | None] = queue.SimpleQueue()
        self._notices: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._tracker: Tracker | None = None
        self._connected = threading.Event()
        self._problem: HeadwayError | None = None
        self._deferred: dict[Callable[[Tracker], object], None] = {}
        """Ordered set of the `catch_up` calls of failed tasks."""
        self._reported: set[str] = set()
        self._failing = False
        self._retry_at = 0.0
        self._abandoned = False

    def connect(self) -> None:
        """Wait until MLflow responds. Raises HeadwayError if it fails or does not respond in time."""
        if self._uri is not None:
            require_answer(self._uri)
        self._start()
        if not self._connected.wait(_CONNECT_SECONDS):
            raise HeadwayError(f"MLflow at {self._where} did not respond within {_CONNECT_SECONDS:g} s")
        if self._problem is not None:
            raise self._problem

    def submit(self, task: TrackingTask) -> None:
        """Append a task to the queue of the thread."""
        if not self._abandoned:
            self._start()
            self._tasks.put(task)

    def notices(self) -> tuple[str, ...]:
        """Return the lines for the user since the last call."""
        lines = []
        while not self._notices.empty():
            lines.append(self._notices.get())
        return tuple(lines)

    def close(self, seconds: float) -> None:
        """Wait, at most `seconds`, until all tasks are done, and end the thread."""
        if self._thread is None:
            return
        self._tasks.put(None)
        self._thread.join(seconds)
        if self._thread.is_alive():
            self._abandoned = True
            self._notices.put(f"MLflow was not up to date after {seconds:g} s: {_LATER}")
        self._thread = None

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="headway-mlflow", daemon=True)
            self._thread.start()

    def _work(self) -> None:
        try:
            self._tracker = Tracker(self._root, self._uri)
        except Exception as error:  # no tracking error may end the session
            self._problem = HeadwayError(_message(error))
            self._fail(error)
        self._connected.set()
        while (task := self._tasks.get()) is not None and not self._abandoned:
            responds = self._tracker is not None or self._reconnect()
            if not (responds and self._try(task.send, task.on_failure)):
                task.on_failure()
                self._deferred[task.catch_up] = None
        if self._deferred and not self._abandoned:
            self._retry_at = 0.0
            self._reconnect()

    def _try(self, step: Callable[[Tracker], object], on_failure: Callable[[], object]) -> bool:
        """Run `step` and return whether MLflow responds; call `on_failure` after an error outside MLflow."""
        assert self._tracker is not None
        try:
            step(self._tracker)
        except TrackingError as error:
            self._fail(error)
            return False
        except Exception as error:  # no tracking error may end the session
            on_failure()
            notice = f"MLflow does not get everything ({_message(error)}): training goes on"
            if notice not in self._reported:
                self._reported.add(notice)
                self._notices.put(notice)
        return True

    def _reconnect(self) -> bool:
        """Return True if MLflow responds again and all deferred updates are sent."""
        if time.monotonic() < self._retry_at:
            return False
        try:
            if self._uri is not None:
                require_answer(self._uri)
            self._tracker = self._tracker or Tracker(self._root, self._uri)
        except Exception as error:
            self._fail(error)
            return False
        waiting = list(self._deferred)
        for catch_up in waiting:
            if not self._try(catch_up, lambda: None):
                return False
            del self._deferred[catch_up]
        self._failing = False
        if waiting:
            self._notices.put(f"MLflow at {self._where} responds again and is up to date")
        return True

    def _fail(self, error: Exception) -> None:
        self._tracker, self._retry_at = None, time.monotonic() + _RETRY_SECONDS
        if not self._failing:
            self._failing = True
            self._notices.put(f"MLflow is behind ({_message(error)}): training goes on, {_LATER}")

    @property
    def _where(self) -> str:
        return without_password(self._uri) if self._uri else "its database"


_LATER = "the runs' folders hold everything, and the next session or `headway sync` brings MLflow up to date"


def _message(error: Exception) -> str:
    return str(error) if isinstance(error, HeadwayError) else f"{type(error).__name__}: {error}"

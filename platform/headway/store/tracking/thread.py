"""The thread that brings a session's news to MLflow, and what becomes of them while it does not answer."""

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
    """One thing to tell MLflow."""

    do: Callable[[Tracker], object]
    lost: Callable[[], object]
    """Called instead, or after it has failed: what it stood for is to be sent anew later."""
    catch_up: Callable[[Tracker], object]
    """Sends all that is missing, once MLflow answers again."""


class TrackingThread:
    """Does errands in order, in a thread of its own. Where MLflow fails, they are put off, a notice says so
    once, and it is tried again now and then and at the end. What fails by itself, as a run that cannot be
    read, is told once and keeps back nothing else. Nothing here ends a session."""

    def __init__(self, root: Path, tracking_uri: str | None) -> None:
        self._root, self._uri = root, tracking_uri
        self._errands: queue.SimpleQueue[TrackingTask | None] = queue.SimpleQueue()
        self._notices: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._tracker: Tracker | None = None
        self._connected = threading.Event()
        self._problem: HeadwayError | None = None
        self._put_off: dict[Callable[[Tracker], object], None] = {}
        """What catches up with the errands that failed, each once, in order."""
        self._told_of: set[str] = set()
        self._away = False
        self._retry_at = 0.0
        self._abandoned = False

    def connect(self) -> None:
        """Wait until MLflow has answered. Raises HeadwayError, within a bound, if it does not."""
        if self._uri is not None:
            require_answer(self._uri)
        self._start()
        if not self._connected.wait(_CONNECT_SECONDS):
            raise HeadwayError(f"MLflow at {self._where} did not answer within {_CONNECT_SECONDS:g} s")
        if self._problem is not None:
            raise self._problem

    def submit(self, errand: TrackingTask) -> None:
        """Let the thread do it, after all given to it before."""
        if not self._abandoned:
            self._start()
            self._errands.put(errand)

    def notices(self) -> tuple[str, ...]:
        """Lines for the user since the last call."""
        lines = []
        while not self._notices.empty():
            lines.append(self._notices.get())
        return tuple(lines)

    def close(self, seconds: float) -> None:
        """Wait (at most so long) until all is done."""
        if self._thread is None:
            return
        self._errands.put(None)
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
        except Exception as error:  # whatever it is, it must not end the session
            self._problem = HeadwayError(_told(error))
            self._fail(error)
        self._connected.set()
        while (errand := self._errands.get()) is not None and not self._abandoned:
            answers = self._tracker is not None or self._reconnect()
            if not (answers and self._try(errand.do, errand.lost)):
                errand.lost()
                self._put_off[errand.catch_up] = None
        if self._put_off and not self._abandoned:
            self._retry_at = 0.0
            self._reconnect()

    def _try(self, step: Callable[[Tracker], object], lost: Callable[[], object]) -> bool:
        """Whether MLflow answers: then the step is done or, for a reason of its own, `lost`."""
        assert self._tracker is not None
        try:
            step(self._tracker)
        except TrackingError as error:
            self._fail(error)
            return False
        except Exception as error:  # whatever it is, it must not end the session
            lost()
            notice = f"MLflow does not get everything ({_told(error)}): training goes on"
            if notice not in self._told_of:
                self._told_of.add(notice)
                self._notices.put(notice)
        return True

    def _reconnect(self) -> bool:
        """Whether MLflow answers again, and knows what was put off."""
        if time.monotonic() < self._retry_at:
            return False
        try:
            if self._uri is not None:
                require_answer(self._uri)
            self._tracker = self._tracker or Tracker(self._root, self._uri)
        except Exception as error:
            self._fail(error)
            return False
        waiting = list(self._put_off)
        for catch_up in waiting:
            if not self._try(catch_up, lambda: None):
                return False
            del self._put_off[catch_up]
        self._away = False
        if waiting:
            self._notices.put(f"MLflow at {self._where} answers again and has what it missed")
        return True

    def _fail(self, error: Exception) -> None:
        self._tracker, self._retry_at = None, time.monotonic() + _RETRY_SECONDS
        if not self._away:
            self._away = True
            self._notices.put(f"MLflow is behind ({_told(error)}): training goes on, {_LATER}")

    @property
    def _where(self) -> str:
        return without_password(self._uri) if self._uri else "its database"


_LATER = "the runs' folders hold everything, and the next session or `headway sync` brings MLflow up to date"


def _told(error: Exception) -> str:
    return str(error) if isinstance(error, HeadwayError) else f"{type(error).__name__}: {error}"

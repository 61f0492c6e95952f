"""Background thread that sends a session's updates to an MLflow server, and retries while it is away."""

import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path

from headway.config.experiment import without_password
from headway.contracts import HeadwayError
from headway.contracts.errors import one_line
from headway.store.tracking.client import Tracker, TrackingError, require_answer

_RETRY_SECONDS = 30.0
_CONNECT_SECONDS = 120.0

TrackingUpdate = Callable[[Tracker], object]
"""Sends something to MLflow. It can be repeated: after a failure it sends only what MLflow lacks."""


class TrackingThread:
    """Sends updates in a background thread; equal pending updates are sent only once.

    While MLflow fails, updates stay pending: one notice says so, and the thread retries at intervals and at
    the end. An update that fails for another reason, such as an unreadable run, gives one notice and is
    skipped. No failure ends the session.
    """

    def __init__(self, root: Path, tracking_uri: str) -> None:
        self._root, self.uri = root, tracking_uri
        self._changed = threading.Condition()
        self._pending: dict[TrackingUpdate, None] = {}
        """Ordered set."""
        self._closing = self._abandoned = False
        self._notices: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reported: set[str] = set()
        self._thread: threading.Thread | None = None
        self._tracker: Tracker | None = None
        self._attempted = threading.Event()
        """Set once the first connection has succeeded or failed."""
        self._problem: Exception | None = None
        """Why MLflow failed last; None while it responds."""
        self._retry_at = 0.0

    def connect(self) -> None:
        """Wait until MLflow responds. Raises HeadwayError if it fails or does not respond in time."""
        require_answer(self.uri)
        self._start()
        attempted = self._attempted.wait(_CONNECT_SECONDS)
        if attempted and self._problem is None:
            return
        self.close(0.0)
        if self._problem is not None:
            raise HeadwayError(one_line(self._problem))
        raise HeadwayError(
            f"MLflow at {without_password(self.uri)} did not respond within {_CONNECT_SECONDS:g} s"
        )

    def submit(self, update: TrackingUpdate) -> None:
        """Send `update` soon; after `close` it is left to the next session."""
        with self._changed:
            self._pending[update] = None
            self._changed.notify()
        self._start()

    def notices(self) -> tuple[str, ...]:
        """Return the lines for the user since the last call."""
        lines = []
        while not self._notices.empty():
            lines.append(self._notices.get())
        return tuple(lines)

    def close(self, seconds: float) -> None:
        """Wait, at most `seconds`, until all updates are sent or MLflow has failed twice; end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is None:
            return
        self._thread.join(seconds)
        if self._thread.is_alive():
            self._abandoned = True
            self._notices.put(f"MLflow was not up to date after {seconds:g} s: {_LATER}")

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="headway-mlflow", daemon=True)
            self._thread.start()

    def _work(self) -> None:
        while not self._closing:
            self._send_pending()
            self._attempted.set()
            with self._changed:
                pause = None if self._problem is None else max(self._retry_at - time.monotonic(), 0.0)
                self._changed.wait_for(self._is_due, pause)
        for _ in range(2):  # once more if MLflow fails
            if self._pending:
                self._send_pending()

    def _is_due(self) -> bool:
        return self._closing or (bool(self._pending) and self._problem is None)

    def _send_pending(self) -> None:
        """Connect if necessary and send the pending updates; those left when MLflow fails stay pending."""
        with self._changed:
            updates, self._pending = self._pending, {}
        unsent = dict(updates)
        try:
            tracker = self._connected()
            for update in updates:
                if self._abandoned:
                    return
                self._apply(update, tracker)
                del unsent[update]
        except Exception as error:  # no tracking error may end the session
            if self._problem is None:
                self._notices.put(f"MLflow is behind ({one_line(error)}): training goes on, {_LATER}")
            self._tracker, self._problem = None, error
            self._retry_at = time.monotonic() + _RETRY_SECONDS
            with self._changed:
                self._pending = unsent | self._pending
        else:
            if self._problem is not None:
                self._notices.put(f"MLflow at {without_password(self.uri)} responds again and is up to date")
            self._problem = None

    def _connected(self) -> Tracker:
        if self._tracker is None:
            require_answer(self.uri)
            self._tracker = Tracker(self._root, self.uri)
        return self._tracker

    def _apply(self, update: TrackingUpdate, tracker: Tracker) -> None:
        """Send an update. Raises TrackingError if MLflow fails; another error becomes a notice."""
        try:
            update(tracker)
        except TrackingError:
            raise
        except Exception as error:  # no tracking error may end the session
            notice = f"MLflow is incomplete ({one_line(error)}): training goes on"
            if notice not in self._reported:
                self._reported.add(notice)
                self._notices.put(notice)


_LATER = "the runs' folders hold everything, and the next session or `headway sync` brings MLflow up to date"

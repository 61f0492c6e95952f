"""Background thread that follows a session's runs into an MLflow server, and retries while it is away."""

import queue
import threading
from collections.abc import Iterator
from pathlib import Path

from headway.config.experiment import without_password
from headway.contracts.errors import one_line
from headway.store.tracking.client import Tracker, TrackingError, require_answer
from headway.store.tracking.sync import RunSync, sync

_PAUSE_SECONDS = 2.0
_RETRY_SECONDS = 30.0
_LATER = "the runs' folders hold everything, and the next session or `headway sync` brings MLflow up to date"


class TrackingThread:
    """Sends what a server lacks of the session's runs, and at the end of all runs that were trained with it.

    While MLflow fails, one notice says so, and the thread tries again at longer intervals and at the end. An
    error of another kind, such as an unreadable run, gives one notice. No failure ends the session.
    """

    def __init__(self, root: Path, tracking_uri: str) -> None:
        """Raise HeadwayError unless MLflow responds."""
        self._root, self._uri = root, tracking_uri
        self._tracker: Tracker | None = self._connected()
        self._runs: dict[Path, RunSync] = {}
        """One per run folder, also if the run is resumed in this session: two would send points twice."""
        self._closing, self._is_abandoned = threading.Event(), False
        self._notices: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reported: set[str] = set()
        self._thread = threading.Thread(target=self._work, name="headway-mlflow", daemon=True)
        self._thread.start()

    def follow(self, directory: Path) -> None:
        """Send the run in a folder from now on."""
        self._runs.setdefault(directory, RunSync(directory))

    def notices(self) -> tuple[str, ...]:
        """Return the lines for the user since the last call."""
        return tuple(self._notices.get() for _ in range(self._notices.qsize()))

    def close(self, seconds: float) -> None:
        """Wait, at most `seconds`, until everything is sent or MLflow has failed twice; end the thread."""
        self._closing.set()
        self._thread.join(seconds)
        if self._thread.is_alive():
            self._is_abandoned = True
            self._notices.put(f"MLflow was not up to date after {seconds:g} s: {_LATER}")

    def _work(self) -> None:
        while not self._closing.wait(_PAUSE_SECONDS if self._tracker else _RETRY_SECONDS):
            self._send()
        if not self._send(is_last=True) and not self._is_abandoned:
            self._send(is_last=True)

    def _send(self, is_last: bool = False) -> bool:
        """Connect if necessary and send what is missing; return whether MLflow has responded."""
        is_back = self._tracker is None
        try:
            self._tracker = self._tracker or self._connected()
            for problem in self._problems(self._tracker, is_last):
                notice = f"MLflow is incomplete ({problem}): training goes on"
                if notice not in self._reported:
                    self._reported.add(notice)
                    self._notices.put(notice)
        except Exception as error:  # no tracking error may end the session
            if not is_back:
                self._notices.put(f"MLflow is behind ({one_line(error)}): training goes on, {_LATER}")
            self._tracker = None
            return False
        if is_back:
            self._notices.put(f"MLflow at {without_password(self._uri)} responds again and is up to date")
        return True

    def _problems(self, tracker: Tracker, is_last: bool) -> Iterator[str]:
        """Send what is missing; yield a line per unreadable run. Raises TrackingError if MLflow fails."""
        for run in list(self._runs.values()):
            if self._is_abandoned:
                return
            try:
                run.send(tracker)
            except TrackingError:
                raise
            except Exception as error:  # no tracking error may end the session
                yield one_line(error)
        if is_last:
            yield from sync(self._root, self._uri, only_own=True).problems

    def _connected(self) -> Tracker:
        require_answer(self._uri)
        return Tracker(self._root, self._uri)

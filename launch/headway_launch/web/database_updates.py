"""Updates of a store's MLflow database from its run folders, while its pages are served."""

import time
from pathlib import Path
from threading import Event, Thread

from headway.contracts.errors import HeadwayError, one_line
from headway.store.index import RunIndex
from headway.store.tracking.client import Tracker
from headway.store.tracking.sync import local_experiment, sync
from headway_launch.console.output import print_line

_PAUSE_S = 10.0


class DatabaseUpdates:
    """Thread that sends to the database what it lacks, of live runs too: at the start and at intervals.

    If the database cannot be written, for instance because it belongs to another user, one notice reports it.
    """

    def __init__(self, root: Path) -> None:
        """Create the database if there is none."""
        self._root = root
        self._reported: set[str] = set()
        self._once = Event()
        self.has_views = False
        """Whether MLflow's experiments have the view of their runs."""
        try:
            Tracker(root)
        except HeadwayError as error:
            self._report(str(error))

    def start(self, seconds: float) -> None:
        """Start the thread, and wait at most `seconds` for its first update."""
        Thread(target=self._work, daemon=True).start()
        if not self._once.wait(seconds):
            print_line("headway: runs are being sent to MLflow's database, the newest first; reload the page")

    def _work(self) -> None:
        while True:
            began = time.monotonic()
            try:
                self.update()
            except Exception as error:  # the pages are served whatever MLflow raises
                self._report(one_line(error))
            finally:
                self._once.set()
            time.sleep(max(_PAUSE_S, time.monotonic() - began))

    def update(self) -> None:
        """Send what the database lacks. Raises HeadwayError if it cannot be written."""
        for line in sync(self._root).problems:
            self._report(line)
        if not self.has_views:
            found = (local_experiment(Path(row.directory)) for row in RunIndex(self._root).rows())
            tracker = Tracker(self._root)
            for experiment in {name for name in found if name}:
                tracker.add_view(experiment)
            self.has_views = True

    def _report(self, problem: str) -> None:
        if problem not in self._reported:
            self._reported.add(problem)
            print_line(f"headway: MLflow's database is not up to date: {problem}")

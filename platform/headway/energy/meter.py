"""The energy meter of a session: divides CodeCarbon's readings among the session's jobs."""

import os
import queue
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import psutil

from headway.config.experiment import EnergyConfig
from headway.energy.gpu import ProcessUtilization, gpu_shares
from headway.energy.ledger import Energy, EnergyLedger, JobUsage
from headway.energy.tracker import (
    NOT_MEASURED,
    PowerModes,
    Readings,
    check_country,
    make_tracker,
    power_modes,
)

_SESSION = "session"
_START_SECONDS = 60.0
_UNKNOWN = Energy(None, None, None, None)


@dataclass(frozen=True)
class EnergyReport:
    """A session's energy: `jobs`, `session` (its own process) and `idle` sum to `total`, the tracker's."""

    jobs: Mapping[str, Energy]
    session: Energy
    idle: Energy
    total: Energy
    modes: PowerModes


class EnergyMeter:
    """Measures the machine's energy while a session runs and divides it among the session's jobs.

    CodeCarbon starts in a separate thread; nothing is measured until it is ready. Not thread-safe.
    """

    def __init__(self, config: EnergyConfig) -> None:
        self.modes = PowerModes()
        self._config = config
        self._readings = Readings()
        self._tracker: Any = None
        self._ledger: EnergyLedger | None = None
        self._early_usage: dict[str, JobUsage] = {}
        self._notices: queue.SimpleQueue[str] = queue.SimpleQueue()
        """Lines for the user, written by both threads."""
        self._failed = False
        """CodeCarbon could not be started; a notice reports it."""
        self._utilization = ProcessUtilization()
        self._starting: threading.Thread | None = None
        self._notified_miss = False

    @classmethod
    def start(cls, config: EnergyConfig) -> Self:
        """Start measuring. Raises HeadwayError for a country whose energy mix CodeCarbon lacks."""
        meter = cls(config)
        if config.enabled:
            if config.country is not None:
                check_country(config.country)
            meter._starting = threading.Thread(target=meter._start, name="headway-energy", daemon=True)
            meter._starting.start()
        return meter

    def wait(self) -> None:
        """Wait until measuring has started or failed, for sessions too short to miss the start."""
        self._wait_for_ledger(_START_SECONDS)

    def sample(self, jobs: Mapping[str, JobUsage]) -> dict[str, Energy]:
        """Measure now, given the usage of the running jobs, and return the energy of each job so far.

        A job is a whole stack of seeds, see `Energy.per_seed`. To be called every `interval_s` seconds.
        """
        ledger = self._wait_for_ledger(0.0)
        if ledger is None:
            self._early_usage.update(jobs)
            return dict.fromkeys(jobs, _UNKNOWN)
        self._measure(ledger, jobs)
        shares = ledger.shares()
        return {job: shares[job] for job in jobs}

    def finish(self, job: str, others: Mapping[str, JobUsage], usage: JobUsage) -> Energy:
        """Measure now and return the energy of `job`, which has ended with `usage`.

        It does not change afterwards. `others` are the jobs still running.
        """
        ledger = self._wait_for_ledger(0.0)
        if ledger is None:
            return _UNKNOWN
        self._measure(ledger, {**others, job: usage})
        return ledger.settle(job)

    def stop(self) -> EnergyReport:
        """Stop measuring, after all jobs have ended, and return the report."""
        ledger = self._wait_for_ledger(_START_SECONDS)
        if ledger is None:
            return EnergyReport({}, _UNKNOWN, _UNKNOWN, _UNKNOWN, self.modes)
        ledger.record(time.monotonic(), _session_usage(), {})
        self._tracker.stop()
        self._close_interval(ledger)
        shares = ledger.shares()
        session = shares.pop(_SESSION)
        return EnergyReport(shares, session, ledger.idle(), ledger.total(), self.modes)

    def notices(self) -> tuple[str, ...]:
        """Return the lines for the user since the last call."""
        return tuple(self._notices.get() for _ in range(self._notices.qsize()))

    def _start(self) -> None:
        try:
            self._tracker = make_tracker(self._config, self._readings)
            self._tracker.start()
            self._tracker.flush()
        except Exception as error:  # no failure of CodeCarbon may end the session
            self._failed = True
            self._notices.put(f"energy is not measured: CodeCarbon failed ({error})")

    def _wait_for_ledger(self, seconds: float) -> EnergyLedger | None:
        if self._starting is not None:
            self._starting.join(seconds)
            if not self._starting.is_alive():
                self._starting = None
                self._open_ledger()
        return self._ledger

    def _open_ledger(self) -> None:
        if self._failed:
            return
        if self._readings.count == 0:
            self._notices.put("energy is not measured: CodeCarbon has no readings on this machine")
            return
        self.modes = power_modes(self._tracker)
        for line in self.modes.notices():
            self._notices.put(line)
        cores, memory = os.cpu_count() or 1, psutil.virtual_memory().total
        self._ledger = EnergyLedger(self._readings.time, cores, memory)
        # CPU seconds used before the first reading are not charged.
        for job, usage in {**self._early_usage, **_session_usage()}.items():
            self._ledger.open(job, usage.cpu_seconds)

    def _measure(self, ledger: EnergyLedger, jobs: Mapping[str, JobUsage]) -> None:
        shares = gpu_shares(jobs, self._utilization.read())
        ledger.record(time.monotonic(), {**jobs, **_session_usage()}, shares)
        count = self._readings.count
        self._tracker.flush()
        if self._readings.count > count:
            self._close_interval(ledger)
        elif not self._notified_miss:
            self._notified_miss = True
            self._notices.put("CodeCarbon missed a reading: its energy is counted with the next one")

    def _close_interval(self, ledger: EnergyLedger) -> None:
        cpu, gpu, ram, kg = self._readings.increment()
        modes = self.modes
        used = Energy(
            None if modes.cpu == NOT_MEASURED else cpu,
            None if modes.gpu == NOT_MEASURED else gpu,
            None if modes.ram == NOT_MEASURED else ram,
            None if self._config.country is None else kg,
        )
        ledger.close_interval(self._readings.time, used)


def _session_usage() -> dict[str, JobUsage]:
    memory = psutil.Process().memory_info().rss
    return {_SESSION: JobUsage(time.process_time(), memory)}

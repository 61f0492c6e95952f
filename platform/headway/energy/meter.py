"""The meter of a session: CodeCarbon's readings, shared out to the session's jobs."""

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
from headway.energy.ledger import Energy, EnergyLedger, Increment, JobUsage
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
    """Measures the machine while a session runs, and shares the energy out to its jobs.

    CodeCarbon starts in a thread of its own; until it is ready nothing is measured. Used from one thread.
    """

    def __init__(self, config: EnergyConfig) -> None:
        self.modes = PowerModes()
        self._config = config
        self._readings = Readings()
        self._tracker: Any = None
        self._ledger: EnergyLedger | None = None
        self._before: dict[str, JobUsage] = {}
        self._notices: queue.SimpleQueue[str] = queue.SimpleQueue()
        """From both threads."""
        self._failed = False
        """CodeCarbon could not be started, and a notice has said so."""
        self._utilization = ProcessUtilization()
        self._starting: threading.Thread | None = None
        self._missed = False

    @classmethod
    def start(cls, config: EnergyConfig) -> Self:
        """Begin to measure. Raises HeadwayError for a country that CodeCarbon has no energy mix of."""
        meter = cls(config)
        if config.enabled:
            if config.country is not None:
                check_country(config.country)
            meter._starting = threading.Thread(target=meter._start, name="headway-energy", daemon=True)
            meter._starting.start()
        return meter

    def wait(self) -> None:
        """Wait until it measures, or is known not to: for what is too short to do without."""
        self._ready(_START_SECONDS)

    def sample(self, jobs: Mapping[str, JobUsage]) -> dict[str, Energy]:
        """Measure now, with what the jobs that run have used as far as known, and give each one's energy
        so far (of the whole stack: see `Energy.per_seed`). To be called every `interval_s` seconds."""
        ledger = self._ready(0.0)
        if ledger is None:
            self._before.update(jobs)
            return dict.fromkeys(jobs, _UNKNOWN)
        self._measure(ledger, jobs)
        shares = ledger.shares()
        return {job: shares[job] for job in jobs}

    def finish(self, job: str, others: Mapping[str, JobUsage], usage: JobUsage) -> Energy:
        """Measure now, and give the energy of `job`, which has ended with `usage`; it is fixed from now on.
        `others` are the jobs that run on."""
        ledger = self._ready(0.0)
        if ledger is None:
            return _UNKNOWN
        self._measure(ledger, {**others, job: usage})
        return ledger.settle(job)

    def stop(self) -> EnergyReport:
        """End the measurement; all jobs have ended."""
        ledger = self._ready(_START_SECONDS)
        if ledger is None:
            return EnergyReport({}, _UNKNOWN, _UNKNOWN, _UNKNOWN, self.modes)
        ledger.use(time.monotonic(), _own_usage(), {})
        self._tracker.stop()
        self._close_interval(ledger)
        shares = ledger.shares()
        session = shares.pop(_SESSION)
        return EnergyReport(shares, session, ledger.idle(), ledger.total(), self.modes)

    def notices(self) -> tuple[str, ...]:
        """Lines for the user since the last call."""
        lines = []
        while not self._notices.empty():
            lines.append(self._notices.get())
        return tuple(lines)

    def _start(self) -> None:
        try:
            self._tracker = make_tracker(self._config, self._readings)
            self._tracker.start()
            self._tracker.flush()
        except Exception as error:  # whatever CodeCarbon meets must not end the session
            self._failed = True
            self._notices.put(f"energy is not measured: CodeCarbon failed ({error})")

    def _ready(self, seconds: float) -> EnergyLedger | None:
        if self._starting is not None:
            self._starting.join(seconds)
            if not self._starting.is_alive():
                self._starting = None
                self._begin()
        return self._ledger

    def _begin(self) -> None:
        if self._failed:
            return
        if self._readings.count == 0:
            self._notices.put("energy is not measured: CodeCarbon gives no reading on this machine")
            return
        self.modes = power_modes(self._tracker)
        for line in self.modes.notices():
            self._notices.put(line)
        cores, memory = os.cpu_count() or 1, psutil.virtual_memory().total
        self._ledger = EnergyLedger(self._readings.time, cores, memory)
        # What was used before the first reading is none of its energy.
        for job, usage in {**self._before, **_own_usage()}.items():
            self._ledger.open(job, usage.cpu_seconds)

    def _measure(self, ledger: EnergyLedger, jobs: Mapping[str, JobUsage]) -> None:
        shares = gpu_shares(jobs, self._utilization.read())
        ledger.use(time.monotonic(), {**jobs, **_own_usage()}, shares)
        count = self._readings.count
        self._tracker.flush()
        if self._readings.count > count:
            self._close_interval(ledger)
        elif not self._missed:
            self._missed = True
            self._notices.put("CodeCarbon missed a reading: its energy is counted with the next")

    def _close_interval(self, ledger: EnergyLedger) -> None:
        cpu, gpu, ram, kg = self._readings.increment()
        modes = self.modes
        increment = Increment(
            None if modes.cpu == NOT_MEASURED else cpu,
            None if modes.gpu == NOT_MEASURED else gpu,
            None if modes.ram == NOT_MEASURED else ram,
            None if self._config.country is None else kg,
        )
        ledger.close_interval(self._readings.time, increment)


def _own_usage() -> dict[str, JobUsage]:
    memory = psutil.Process().memory_info().rss
    return {_SESSION: JobUsage(time.process_time(), memory)}

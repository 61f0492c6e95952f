"""The energy of a session, measured once for the machine and divided among its jobs."""

import time
from collections.abc import Sequence

from headway.config.experiment import EnergyConfig
from headway.energy.meter import EnergyMeter, EnergyReport
from headway.events import Row
from headway_launch.runner.recorder import JobRecorder
from headway_launch.runner.session_job import SessionJob

_noticed: set[str] = set()
"""Lines for the user so far: a process may run several sessions, as many as a search has rungs."""


class SessionEnergy:
    """Divides the measured energy among the jobs of a session and stores each one's share in its runs."""

    def __init__(self, config: EnergyConfig, jobs: Sequence[SessionJob]) -> None:
        """Start measuring. Raises HeadwayError for a country whose energy mix CodeCarbon lacks."""
        self._config, self._jobs = config, jobs
        self._meter = EnergyMeter.start(config) if jobs else None
        self._sampled = time.monotonic()

    @property
    def modes(self) -> dict[str, str]:
        """Source of each part's power, as tags of runs; empty if energy is not measured."""
        return self._meter.modes.as_tags() if self._meter and self._config.enabled else {}

    def sample_if_due(self) -> None:
        """Store a sample of each running job if `energy.interval_s` has passed since the last."""
        now = time.monotonic()
        if self._meter is None or now - self._sampled < self._config.interval_s:
            return
        self._sampled = now
        running = self._running()
        energies = self._meter.sample({account: recorder.usage for account, recorder in running.items()})
        for account, recorder in running.items():
            recorder.keep_energy(time.time(), energies[account])

    def finish(self, job: SessionJob) -> Sequence[Row]:
        """Store the last sample of a job that has ended; return it, one row per seed."""
        assert self._meter is not None
        assert job.recorder is not None
        running = self._running().items()
        others = {account: recorder.usage for account, recorder in running if account != job.account}
        energy = self._meter.finish(job.account, others, job.recorder.usage)
        return job.recorder.keep_energy(time.time(), energy)

    def _running(self) -> dict[str, JobRecorder]:
        """Return the recorders of the running jobs, by account."""
        jobs = self._jobs
        return {job.account: job.recorder for job in jobs if job.recorder and job.stored_status == "RUNNING"}

    def notices(self) -> tuple[str, ...]:
        """Return the lines for the user since the last call, without those of earlier sessions."""
        lines = [line for line in (self._meter.notices() if self._meter else ()) if line not in _noticed]
        _noticed.update(lines)
        return tuple(lines)

    def stop(self) -> dict[str, float]:
        """Stop measuring; return the machine's energy in kWh, and the parts of it that no run used."""
        return _session_metrics(self._meter.stop()) if self._meter else {}


def _session_metrics(report: EnergyReport) -> dict[str, float]:
    parts = {"total": report.total, "session": report.session, "idle": report.idle}
    return {f"energy_{name}_kwh": part.kwh for name, part in parts.items() if part.kwh is not None}

"""How a machine's energy is shared out to the jobs that ran on it; all shares sum to the machine's total.

In each interval a job gets of the CPU's energy its CPU seconds over (wall time x cores), of the RAM's its
memory over the machine's, of the GPU's its share as reported; the rest is idle. A job may report its CPU
seconds rarely (once an iteration): what it reports is spread evenly over the time since its last report.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

_Shares = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class JobUsage:
    """What a job has used, as far as known now."""

    cpu_seconds: float
    """CPU seconds of all its processes since they started."""
    memory_bytes: int
    """Proportional memory of all its processes."""
    uses_gpu: bool = False
    process_ids: tuple[int, ...] = ()
    """Its processes, to tell jobs apart that share a GPU."""


@dataclass(frozen=True, slots=True)
class Energy:
    """Energy used by a job, a seed or a machine. None where it could not be measured: never 0 for that."""

    cpu_kwh: float | None
    gpu_kwh: float | None
    ram_kwh: float | None
    kg_co2: float | None
    """kg of CO2 equivalent of the energy that is known."""
    cpu_seconds: float = 0.0
    duration_s: float = 0.0

    @property
    def kwh(self) -> float | None:
        """Sum of the parts that are known; None if none is."""
        known = [part for part in (self.cpu_kwh, self.gpu_kwh, self.ram_kwh) if part is not None]
        return sum(known) if known else None

    def per_seed(self, seeds: int) -> "Energy":
        """The share of one of so many seeds: all equal, and all as long."""

        def share(part: float | None) -> float | None:
            return None if part is None else part / seeds

        return Energy(
            share(self.cpu_kwh),
            share(self.gpu_kwh),
            share(self.ram_kwh),
            share(self.kg_co2),
            cpu_seconds=self.cpu_seconds / seeds,
            duration_s=self.duration_s,
        )

    def as_row(self) -> dict[str, float]:
        """The known figures by name, `kwh` included, for logs and summaries."""
        row = {**asdict(self), "kwh": self.kwh}
        return {name: value for name, value in row.items() if value is not None}


@dataclass(frozen=True, slots=True)
class Increment:
    """What a machine used in one interval; None for a part that cannot be measured."""

    cpu_kwh: float | None
    gpu_kwh: float | None
    ram_kwh: float | None
    kg_co2: float | None


class _Account:
    """One job's reports."""

    def __init__(self, began: float, interval: int, cpu_seconds: float = 0.0) -> None:
        self.times, self.cpu_seconds = [began], [cpu_seconds]
        self.first_interval = interval
        self.seen = began
        self.memory: dict[int, float] = {}
        """Share of the machine's memory by interval."""
        self.gpu: dict[int, float] = {}
        """Share of the GPU's energy by interval."""

    def report(self, time: float, cpu_seconds: float) -> None:
        self.seen = time
        # No news is not idleness: the next report covers this time too.
        if cpu_seconds > self.cpu_seconds[-1]:
            self.times.append(time)
            self.cpu_seconds.append(cpu_seconds)


class Ledger:
    """Intervals of a machine's energy, and the accounts of the jobs that share it."""

    def __init__(self, began: float, cores: int, memory_bytes: int) -> None:
        self._bounds = [began]
        self._increments: list[Increment] = []
        self._machine = np.zeros((0, 4))
        """(intervals, 4): kWh of CPU, GPU and RAM, and kg CO2eq; 0 where unknown."""
        self._cores, self._memory_bytes = cores, memory_bytes
        self._accounts: dict[str, _Account] = {}
        self._settled: dict[str, Energy] = {}
        self._spent = np.zeros((0, 4))
        """(intervals, 4): what settled jobs took: CPU seconds, and kWh of CPU, GPU and RAM."""

    @property
    def end(self) -> float:
        """When the last interval ended."""
        return self._bounds[-1]

    def open(self, job: str, cpu_seconds: float) -> None:
        """Begin a job's account with CPU seconds that it used before now."""
        self._accounts[job] = _Account(self._bounds[-1], len(self._increments), cpu_seconds)

    def use(self, time: float, jobs: Mapping[str, JobUsage], gpu_shares: Mapping[str, float]) -> None:
        """Note what jobs report at `time`, in the interval that is open. GPU shares sum to at most 1."""
        interval = len(self._increments)
        for job, usage in jobs.items():
            if job in self._settled:
                continue
            account = self._accounts.setdefault(job, _Account(self._bounds[-1], interval))
            account.report(time, usage.cpu_seconds)
            account.memory[interval] = usage.memory_bytes / self._memory_bytes
            account.gpu[interval] = gpu_shares.get(job, 0.0)

    def close_interval(self, time: float, increment: Increment) -> None:
        """End the open interval with what the machine used in it."""
        self._bounds.append(time)
        self._increments.append(increment)
        parts = (increment.cpu_kwh, increment.gpu_kwh, increment.ram_kwh, increment.kg_co2)
        self._machine = np.vstack([self._machine, [part or 0.0 for part in parts]])
        self._spent = np.vstack([self._spent, np.zeros((1, 4))])

    def settle(self, job: str) -> Energy:
        """The energy of a job that has ended; it is fixed from now on."""
        if job not in self._settled:
            if job not in self._accounts:
                self.open(job, 0.0)
            used = self._used()[job]
            self._settled[job] = self._energy(used, self._accounts.pop(job))
            self._spent = self._spent + used
        return self._settled[job]

    def shares(self) -> dict[str, Energy]:
        """The energy of every job so far."""
        used = self._used()
        return self._settled | {
            job: self._energy(used[job], account) for job, account in self._accounts.items()
        }

    def idle(self) -> Energy:
        """What no job has used."""
        spent = self._spent + sum(self._used().values(), np.zeros_like(self._spent))
        rest = np.column_stack([np.zeros(len(spent)), self._machine[:, :3] - spent[:, 1:]])
        return self._energy(np.maximum(rest, 0.0), None)

    def total(self) -> Energy:
        """What the machine has used."""
        parts = np.column_stack([np.zeros(len(self._increments)), self._machine[:, :3]])
        return self._energy(parts, None)

    def _used(self) -> dict[str, _Shares]:
        """Of each job not settled (intervals, 4), as `_spent`."""
        bounds, machine = np.array(self._bounds), self._machine[:, :3]
        capacity = np.maximum(np.diff(bounds) * self._cores, 1e-12)
        wanted = {
            job: np.column_stack(
                [
                    np.diff(np.interp(bounds, account.times, account.cpu_seconds)),
                    _column(account.gpu, len(capacity)),
                    _column(account.memory, len(capacity)),
                ]
            )
            for job, account in self._accounts.items()
        }
        sums = sum(wanted.values(), np.zeros((len(capacity), 3)))
        with np.errstate(divide="ignore", invalid="ignore"):
            gone = np.where(machine[:, 1:] > 0, self._spent[:, 2:] / machine[:, 1:], 0.0)
        left = np.column_stack([capacity - self._spent[:, 0], 1.0 - gone])
        # Jobs that together claim more than there is (reports are not simultaneous) are cut alike.
        scale = np.clip(left / np.maximum(sums, 1e-300), 0.0, 1.0)
        used = {}
        for job, claims in wanted.items():
            granted = claims * scale
            cpu = machine[:, 0] * granted[:, 0] / capacity
            used[job] = np.column_stack([granted[:, 0], cpu, machine[:, 1:] * granted[:, 1:]])
        return used

    def _energy(self, used: _Shares, account: _Account | None) -> Energy:
        machine, kg = self._machine[:, :3].sum(axis=1), self._machine[:, 3]
        share = np.divide(used[:, 1:].sum(axis=1), machine, out=np.zeros(len(machine)), where=machine > 0)
        cpu, gpu, ram = used[:, 1:].sum(axis=0)
        known = self._known(account.first_interval if account else 0)
        return Energy(
            cpu_kwh=float(cpu) if known["cpu_kwh"] else None,
            gpu_kwh=float(gpu) if known["gpu_kwh"] else None,
            ram_kwh=float(ram) if known["ram_kwh"] else None,
            kg_co2=float(kg @ share) if known["kg_co2"] else None,
            cpu_seconds=account.cpu_seconds[-1] if account else 0.0,
            duration_s=account.seen - account.times[0] if account else self._bounds[-1] - self._bounds[0],
        )

    def _known(self, first: int) -> dict[str, bool]:
        """Which parts were measured in some interval from `first` on."""
        return {
            item.name: any(getattr(part, item.name) is not None for part in self._increments[first:])
            for item in fields(Increment)
        }


def _column(by_interval: Mapping[int, float], intervals: int) -> _Shares:
    column = np.zeros(intervals)
    # An interval noted but still open has no place yet.
    known = [(index, share) for index, share in by_interval.items() if index < intervals]
    if known:
        indices, shares = zip(*known, strict=True)
        column[list(indices)] = shares
    return column

"""How a machine's energy is shared out to the jobs that ran on it; all shares sum to the machine's total.

In each interval a job gets of the CPU's energy its CPU seconds over (wall time x cores), of the RAM's its
memory over the machine's, of the GPU's its share as reported; the rest is idle. A job may report its CPU
seconds rarely (once an iteration): what it reports is spread evenly over the time since its last report.
"""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

_Shares = NDArray[np.float64]
_PARTS = ("cpu_kwh", "gpu_kwh", "ram_kwh", "kg_co2")
_COLUMNS = 1 + len(_PARTS)


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
    """One job's reports. `memory` and `gpu` are its shares of the machine's by interval."""

    def __init__(self, began: float, cpu_seconds: float = 0.0) -> None:
        self.began = self.seen = began
        self.times, self.cpu_seconds = [began], [cpu_seconds]
        self.memory: dict[int, float] = {}
        self.gpu: dict[int, float] = {}
        self.folded = np.zeros(_COLUMNS)
        self.known = np.zeros(len(_PARTS), np.bool_)
        """Which parts were measured in some interval of its time."""

    def report(self, time: float, cpu_seconds: float) -> None:
        self.seen = time
        # No news is not idleness: the next report covers this time too.
        if cpu_seconds > self.cpu_seconds[-1]:
            self.times.append(time)
            self.cpu_seconds.append(cpu_seconds)

    def forget_before(self, time: float) -> None:
        """Drop reports that no time from `time` on lies between."""
        past = max(bisect_right(self.times, time) - 1, 0)
        del self.times[:past], self.cpu_seconds[:past]

    def column(self, by_interval: Mapping[int, float], first: int, count: int) -> _Shares:
        return np.array([by_interval.get(first + index, 0.0) for index in range(count)])


class EnergyLedger:
    """Intervals of a machine's energy, and the accounts of the jobs that share it.

    Only the intervals that some job has yet to report on are kept; the rest is folded into sums.
    """

    def __init__(self, began: float, cores: int, memory_bytes: int) -> None:
        self._began = began
        self._bounds = [began]
        self._first = 0
        """Number of intervals folded."""
        self._machine = np.zeros((0, _COLUMNS))
        """(intervals, columns): capacity in CPU seconds, kWh of CPU, GPU and RAM, kg CO2eq; 0 if unknown."""
        self._spent = np.zeros((0, _COLUMNS))
        """The same, of jobs settled since."""
        self._folded = np.zeros(_COLUMNS)
        self._folded_spent = np.zeros(_COLUMNS)
        self._known = np.zeros(len(_PARTS), np.bool_)
        self._cores, self._memory_bytes = cores, memory_bytes
        self._accounts: dict[str, _Account] = {}
        self._settled: dict[str, Energy] = {}

    def open(self, job: str, cpu_seconds: float) -> None:
        """Begin a job's account with CPU seconds that it used before now."""
        self._accounts[job] = _Account(self._bounds[-1], cpu_seconds)

    def use(self, time: float, jobs: Mapping[str, JobUsage], gpu_shares: Mapping[str, float]) -> None:
        """Note what jobs report at `time`, in the interval that is open. GPU shares sum to at most 1."""
        interval = self._first + len(self._machine)
        for job, usage in jobs.items():
            if job in self._settled:
                continue
            account = self._accounts.setdefault(job, _Account(self._bounds[-1]))
            account.report(time, usage.cpu_seconds)
            account.memory[interval] = usage.memory_bytes / self._memory_bytes
            account.gpu[interval] = gpu_shares.get(job, 0.0)

    def close_interval(self, time: float, increment: Increment) -> None:
        """End the open interval with what the machine used in it."""
        capacity = max((time - self._bounds[-1]) * self._cores, 1e-12)
        parts = [getattr(increment, part) for part in _PARTS]
        known = np.array([part is not None for part in parts])
        self._known |= known
        for account in self._accounts.values():
            account.known |= known
        self._bounds.append(time)
        self._machine = np.vstack([self._machine, [capacity, *(part or 0.0 for part in parts)]])
        self._spent = np.vstack([self._spent, np.zeros(_COLUMNS)])
        self._fold()

    def settle(self, job: str) -> Energy:
        """The energy of a job that has ended; it is fixed from now on."""
        if job not in self._settled:
            if job not in self._accounts:
                self.open(job, 0.0)
            used = self._used()[job]
            self._settled[job] = self._energy_of(job, used)
            self._spent = self._spent + used
            self._folded_spent += self._accounts.pop(job).folded
        return self._settled[job]

    def shares(self) -> dict[str, Energy]:
        """The energy of every job so far."""
        used = self._used()
        return self._settled | {job: self._energy_of(job, used[job]) for job in self._accounts}

    def idle(self) -> Energy:
        """What no job has used."""
        used = sum(self._used().values(), np.zeros_like(self._spent))
        taken = self._folded_spent + (self._spent + used).sum(axis=0)
        taken += sum((account.folded for account in self._accounts.values()), np.zeros(_COLUMNS))
        rest = np.maximum(self._folded + self._machine.sum(axis=0) - taken, 0.0)
        return _energy(rest, self._known, 0.0, self._bounds[-1] - self._began)

    def total(self) -> Energy:
        """What the machine has used."""
        whole = self._folded + self._machine.sum(axis=0)
        return _energy(whole, self._known, 0.0, self._bounds[-1] - self._began)

    def _energy_of(self, job: str, used: _Shares) -> Energy:
        account = self._accounts[job]
        sums = account.folded + used.sum(axis=0)
        return _energy(sums, account.known, account.cpu_seconds[-1], account.seen - account.began)

    def _used(self) -> dict[str, _Shares]:
        """Of each job not settled, what it used in each interval kept: columns as `_machine`'s."""
        bounds, machine, count = np.array(self._bounds), self._machine, len(self._machine)
        wanted = {
            job: np.column_stack(
                [
                    np.diff(np.interp(bounds, account.times, account.cpu_seconds)) / machine[:, 0],
                    account.column(account.gpu, self._first, count),
                    account.column(account.memory, self._first, count),
                ]
            )
            for job, account in self._accounts.items()
        }
        # Jobs that together claim more than there is (reports are not simultaneous) are cut alike.
        sums = sum(wanted.values(), np.zeros((count, 3)))
        parts = machine[:, 1:4]
        gone = np.divide(self._spent[:, 1:4], parts, out=np.zeros((count, 3)), where=parts > 0)
        gone[:, 0] = self._spent[:, 0] / machine[:, 0]
        scale = np.clip((1.0 - gone) / np.maximum(sums, 1e-300), 0.0, 1.0)
        return {job: self._granted(claims * scale) for job, claims in wanted.items()}

    def _granted(self, shares: _Shares) -> _Shares:
        """(intervals, columns) of (intervals, 3) shares of the CPU, the GPU and the RAM."""
        machine = self._machine
        kwh = shares * machine[:, 1:4]
        whole = machine[:, 1:4].sum(axis=1)
        share = np.divide(kwh.sum(axis=1), whole, out=np.zeros(len(whole)), where=whole > 0)
        return np.column_stack([shares[:, 0] * machine[:, 0], kwh, share * machine[:, 4]])

    def _fold(self) -> None:
        """Sum up the leading intervals on which every job has reported: no later report changes them."""
        horizon = min((account.times[-1] for account in self._accounts.values()), default=self._bounds[-1])
        count = int(np.searchsorted(self._bounds[1:], horizon, side="right"))
        if count == 0:
            return
        used = self._used()
        for job, account in self._accounts.items():
            account.folded += used[job][:count].sum(axis=0)
            for interval in range(self._first, self._first + count):
                account.memory.pop(interval, None)
                account.gpu.pop(interval, None)
        self._folded += self._machine[:count].sum(axis=0)
        self._folded_spent += self._spent[:count].sum(axis=0)
        self._machine, self._spent = self._machine[count:], self._spent[count:]
        self._bounds = self._bounds[count:]
        self._first += count
        for account in self._accounts.values():
            account.forget_before(self._bounds[0])


def _energy(sums: _Shares, known: NDArray[np.bool_], cpu_seconds: float, duration_s: float) -> Energy:
    cpu, gpu, ram, kg = (float(sums[1 + index]) if known[index] else None for index in range(len(_PARTS)))
    return Energy(cpu, gpu, ram, kg, cpu_seconds, duration_s)

"""Division of a machine's energy among the jobs that run on it, such that all shares sum to the total.

In each interval a job's share of the CPU energy is its CPU seconds / (wall time x cores), its share of the
RAM energy is its memory / the machine's memory, and its share of the GPU energy is given. The rest is idle.
CPU seconds may be reported rarely (once per iteration); they are spread evenly over the time since the last
report.
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
    """CPU time and memory of a job, and whether it uses a GPU, at its last report."""

    cpu_seconds: float
    """CPU seconds of all its processes since they started."""
    memory_bytes: int
    """Proportional memory of all its processes."""
    uses_gpu: bool = False
    process_ids: tuple[int, ...] = ()
    """Processes of the job, which identify it among the users of a GPU."""


@dataclass(frozen=True, slots=True)
class Energy:
    """Energy used by a job, a seed or a machine. A part that could not be measured is None, never 0."""

    cpu_kwh: float | None
    gpu_kwh: float | None
    ram_kwh: float | None
    kg_co2: float | None
    """Emissions of the known energy, in kg CO2 equivalent."""
    cpu_seconds: float = 0.0

    @property
    def kwh(self) -> float | None:
        """Sum of the known parts in kWh; None if no part is known."""
        known = [part for part in (self.cpu_kwh, self.gpu_kwh, self.ram_kwh) if part is not None]
        return sum(known) if known else None

    def per_seed(self, seeds: int) -> "Energy":
        """Return the share of one of `seeds` seeds: an equal part of everything."""
        parts: dict[str, float | None] = {name: getattr(self, name) for name in _PARTS}
        shares = {name: None if part is None else part / seeds for name, part in parts.items()}
        return Energy(**shares, cpu_seconds=self.cpu_seconds / seeds)

    def as_row(self) -> dict[str, float]:
        """Return the known values by name, `kwh` included, for logs and summaries."""
        row = {**asdict(self), "kwh": self.kwh}
        return {name: value for name, value in row.items() if value is not None}


class _Account:
    """The reports of one job. `memory` and `gpu` are its shares of the machine's, by interval."""

    def __init__(self, start: float, cpu_seconds: float = 0.0) -> None:
        self.times, self.cpu_seconds = [start], [cpu_seconds]
        self.memory: dict[int, float] = {}
        self.gpu: dict[int, float] = {}
        self.folded = np.zeros(_COLUMNS)
        """Sums over the intervals that the ledger no longer keeps."""
        self.known = np.zeros(len(_PARTS), np.bool_)
        """Parts that were measured in at least one interval since the account was opened."""

    def report(self, time: float, cpu_seconds: float) -> None:
        # An unchanged count means "not reported yet": the next report covers this time too.
        if cpu_seconds > self.cpu_seconds[-1]:
            self.times.append(time)
            self.cpu_seconds.append(cpu_seconds)

    def drop_before(self, time: float) -> None:
        """Drop the reports that are not needed to interpolate at `time` or later."""
        past = max(bisect_right(self.times, time) - 1, 0)
        del self.times[:past], self.cpu_seconds[:past]

    def values(self, by_interval: Mapping[int, float], first: int, count: int) -> _Shares:
        return np.array([by_interval.get(first + index, 0.0) for index in range(count)])


class EnergyLedger:
    """A machine's energy by interval, and the accounts of the jobs among which it is divided.

    Intervals are kept until every job has reported on them and then folded into sums.
    """

    def __init__(self, start: float, cores: int, memory_bytes: int) -> None:
        self._bounds = [start]
        self._first = 0
        """Number of intervals folded."""
        self._machine = np.zeros((0, _COLUMNS))
        """(intervals, columns): capacity in CPU seconds, kWh of CPU, GPU and RAM, kg CO2eq; 0 if unknown."""
        self._spent = np.zeros((0, _COLUMNS))
        """Usage of settled jobs in these intervals, same columns."""
        self._folded = np.zeros(_COLUMNS)
        self._folded_spent = np.zeros(_COLUMNS)
        self._known = np.zeros(len(_PARTS), np.bool_)
        self._cores, self._memory_bytes = cores, memory_bytes
        self._accounts: dict[str, _Account] = {}
        self._settled: dict[str, Energy] = {}

    def open(self, job: str, cpu_seconds: float) -> None:
        """Open a job's account. The `cpu_seconds` used before are not charged."""
        self._accounts[job] = _Account(self._bounds[-1], cpu_seconds)

    def record(self, time: float, jobs: Mapping[str, JobUsage], gpu_shares: Mapping[str, float]) -> None:
        """Record the jobs' reports at `time` in the open interval. GPU shares sum to at most 1."""
        interval = self._first + len(self._machine)
        for job, usage in jobs.items():
            if job in self._settled:
                continue
            account = self._accounts.setdefault(job, _Account(self._bounds[-1]))
            account.report(time, usage.cpu_seconds)
            account.memory[interval] = usage.memory_bytes / self._memory_bytes
            account.gpu[interval] = gpu_shares.get(job, 0.0)

    def close_interval(self, time: float, used: Energy) -> None:
        """Close the open interval at `time` with the energy that the machine used in it."""
        capacity = max((time - self._bounds[-1]) * self._cores, 1e-12)
        parts = [getattr(used, part) for part in _PARTS]
        known = np.array([part is not None for part in parts])
        self._known |= known
        for account in self._accounts.values():
            account.known |= known
        self._bounds.append(time)
        self._machine = np.vstack([self._machine, [capacity, *(part or 0.0 for part in parts)]])
        self._spent = np.vstack([self._spent, np.zeros(_COLUMNS)])
        self._fold()

    def settle(self, job: str) -> Energy:
        """Return the energy of a job that has ended. It does not change afterwards."""
        if job not in self._settled:
            if job not in self._accounts:
                self.open(job, 0.0)
            used = self._interval_usage()[job]
            self._settled[job] = self._energy_of(job, used)
            self._spent = self._spent + used
            self._folded_spent += self._accounts.pop(job).folded
        return self._settled[job]

    def shares(self) -> dict[str, Energy]:
        """Return the energy of every job so far."""
        used = self._interval_usage()
        return self._settled | {job: self._energy_of(job, used[job]) for job in self._accounts}

    def idle(self) -> Energy:
        """Return the energy that no job has used."""
        used = sum(self._interval_usage().values(), np.zeros_like(self._spent))
        taken = self._folded_spent + (self._spent + used).sum(axis=0)
        taken += sum((account.folded for account in self._accounts.values()), np.zeros(_COLUMNS))
        rest = np.maximum(self._folded + self._machine.sum(axis=0) - taken, 0.0)
        return _energy(rest, self._known, 0.0)

    def total(self) -> Energy:
        """Return the energy that the machine has used."""
        whole = self._folded + self._machine.sum(axis=0)
        return _energy(whole, self._known, 0.0)

    def _energy_of(self, job: str, used: _Shares) -> Energy:
        account = self._accounts[job]
        sums = account.folded + used.sum(axis=0)
        return _energy(sums, account.known, account.cpu_seconds[-1])

    def _interval_usage(self) -> dict[str, _Shares]:
        """Return, by unsettled job, its usage per kept interval, with the columns of `_machine`."""
        bounds, machine, count = np.array(self._bounds), self._machine, len(self._machine)
        claimed = {
            job: np.column_stack(
                [
                    np.diff(np.interp(bounds, account.times, account.cpu_seconds)) / machine[:, 0],
                    account.values(account.gpu, self._first, count),
                    account.values(account.memory, self._first, count),
                ]
            )
            for job, account in self._accounts.items()
        }
        # Reports are not simultaneous: claims of more than is left are scaled down by a common factor.
        sums = sum(claimed.values(), np.zeros((count, 3)))
        parts = machine[:, 1:4]
        spent_share = np.divide(self._spent[:, 1:4], parts, out=np.zeros((count, 3)), where=parts > 0)
        spent_share[:, 0] = self._spent[:, 0] / machine[:, 0]
        scale = np.clip((1.0 - spent_share) / np.maximum(sums, 1e-300), 0.0, 1.0)
        return {job: self._allocate(claims * scale) for job, claims in claimed.items()}

    def _allocate(self, shares: _Shares) -> _Shares:
        """Convert shares of CPU, GPU and RAM, (intervals, 3), to usage, (intervals, columns).

        CO2 is allocated by the share of the total energy.
        """
        machine = self._machine
        kwh = shares * machine[:, 1:4]
        whole = machine[:, 1:4].sum(axis=1)
        share = np.divide(kwh.sum(axis=1), whole, out=np.zeros(len(whole)), where=whole > 0)
        return np.column_stack([shares[:, 0] * machine[:, 0], kwh, share * machine[:, 4]])

    def _fold(self) -> None:
        """Fold the leading intervals on which every job has reported, as later reports cannot change them."""
        horizon = min((account.times[-1] for account in self._accounts.values()), default=self._bounds[-1])
        count = int(np.searchsorted(self._bounds[1:], horizon, side="right"))
        if count == 0:
            return
        used = self._interval_usage()
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
            account.drop_before(self._bounds[0])


def _energy(sums: _Shares, known: NDArray[np.bool_], cpu_seconds: float) -> Energy:
    cpu, gpu, ram, kg = (float(sums[1 + index]) if known[index] else None for index in range(len(_PARTS)))
    return Energy(cpu, gpu, ram, kg, cpu_seconds)

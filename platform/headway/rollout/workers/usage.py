"""CPU time and memory of processes, as the operating system counts them."""

import os
import sys
import time
from pathlib import Path

from headway.events import Usage

_MEMORY_EVERY_S = 5.0
"""Minimum time between two readings of proportional memory, which take up to some milliseconds each."""


class OwnUsage:
    """Reader of this process's usage. The memory is up to some seconds old."""

    def __init__(self) -> None:
        self._memory_bytes, self._read_at = 0, -_MEMORY_EVERY_S

    def read(self) -> Usage:
        """Return the current usage."""
        now = time.monotonic()
        if now - self._read_at >= _MEMORY_EVERY_S:
            self._memory_bytes, self._read_at = proportional_memory(), now
        return Usage(time.process_time(), self._memory_bytes)


def cpu_seconds_of(process_id: int) -> float:
    """Return the CPU seconds of another process since it started; 0 if it has ended."""
    import psutil  # imported here because workers do not need it

    try:
        times = psutil.Process(process_id).cpu_times()
    except psutil.Error:
        return 0.0
    return float(times.user + times.system)


def usable_cores() -> int:
    """Return the number of logical processors that this process may run on."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def proportional_memory() -> int:
    """Return this process's proportional set size in bytes; 0 on systems that do not report it.

    In the proportional set size (Linux), a shared page counts 1/k for each of its k processes.
    """
    return _field(Path("/proc/self/smaps_rollup"), "Pss:") or 0


def available_memory(proc: Path = Path("/proc"), group: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return the bytes available without swapping; None on systems that do not report them.

    Limited by the machine's memory and, in a container, by its control group (version 2), whose page cache
    is available too.
    """
    bounds = [_field(proc / "meminfo", "MemAvailable:")]
    names = ("memory.max", "memory.current", "memory.stat")
    try:
        limit, used, statistics = ((group / name).read_text().strip() for name in names)
    except OSError:
        limit, used, statistics = "max", "", ""
    if limit != "max":
        counts = dict(line.split() for line in statistics.splitlines())
        cache = sum(int(counts.get(name, 0)) for name in ("active_file", "inactive_file"))
        bounds.append(max(int(limit) - int(used) + cache, 0))
    return min((bound for bound in bounds if bound is not None), default=None)


def _field(path: Path, name: str) -> int | None:
    """Return a field given in kB, in bytes, from a file of /proc; None if it is missing."""
    try:
        text = path.read_text()
    except OSError:
        return None
    found = [line.split()[1] for line in text.splitlines() if line.startswith(name)]
    return int(found[0]) * 1024 if found else None

"""What a process has used and could still have, by the operating system's account."""

import os
import sys
import time
from pathlib import Path

from headway.events import Usage

_MEMORY_EVERY_S = 5.0
"""Reading proportional memory takes up to milliseconds, so it is not done at every iteration."""


class OwnUsage:
    """Tells what this process has used; the memory may be some seconds old."""

    def __init__(self) -> None:
        self._memory_bytes, self._read_at = 0, -_MEMORY_EVERY_S

    def read(self) -> Usage:
        """As of now."""
        now = time.monotonic()
        if now - self._read_at >= _MEMORY_EVERY_S:
            self._memory_bytes, self._read_at = proportional_memory(), now
        return Usage(cpu_seconds(), self._memory_bytes)


def cpu_seconds() -> float:
    """CPU seconds of this process, all its threads, since it started."""
    return time.process_time()


def cpu_seconds_of(process_id: int) -> float:
    """CPU seconds of another process since it started; 0 where it is gone."""
    import psutil  # workers, which tell their own, do without

    try:
        times = psutil.Process(process_id).cpu_times()
    except psutil.Error:
        return 0.0
    return float(times.user + times.system)


def usable_cores() -> int:
    """Logical processors that this process may run on."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def proportional_memory() -> int:
    """Bytes of this process, shared pages divided by their users (Linux's PSS); 0 where it cannot be told."""
    return _field(Path("/proc/self/smaps_rollup"), "Pss:") or 0


def available_memory(proc: Path = Path("/proc"), group: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Bytes that could still be had without swapping, within the machine and, in a container, within its
    control group (version 2); None where it cannot be told."""
    bounds = [_field(proc / "meminfo", "MemAvailable:")]
    try:
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
    except OSError:
        limit, used = "max", ""
    if limit != "max":
        bounds.append(max(int(limit) - int(used), 0))
    return min((bound for bound in bounds if bound is not None), default=None)


def _field(path: Path, name: str) -> int | None:
    """A field in kB of a file of /proc, in bytes; None where there is none."""
    try:
        text = path.read_text()
    except OSError:
        return None
    found = [line.split()[1] for line in text.splitlines() if line.startswith(name)]
    return int(found[0]) * 1024 if found else None

"""Which job a GPU worked for."""

from collections.abc import Mapping
from typing import Any

from headway.energy.ledger import JobUsage


def gpu_shares(jobs: Mapping[str, JobUsage], utilization: Mapping[int, float]) -> dict[str, float]:
    """Share of the GPUs' energy of each job that uses one, summing to 1, or nothing if none does.

    By the utilisation of its processes (process id -> any scale) where the driver tells it, else all alike
    (in a container the driver's process ids are not ours).
    """
    users = {job: usage for job, usage in jobs.items() if usage.uses_gpu}
    weights = {
        job: sum(utilization.get(pid, 0.0) for pid in usage.process_ids) for job, usage in users.items()
    }
    if not any(weights.values()):
        weights = dict.fromkeys(users, 1.0)
    total = sum(weights.values())
    return {job: weight / total for job, weight in weights.items()}


class ProcessUtilization:
    """Utilisation of all NVIDIA GPUs by process, read by NVML since the last reading."""

    def __init__(self) -> None:
        self._devices: list[Any] | None = None
        self._since = 0
        """Microseconds since 1970, as NVML counts."""

    def read(self) -> dict[int, float]:
        """Process id -> sum of its samples of multiprocessor utilisation; empty where NVML cannot tell."""
        import pynvml

        if self._devices is None:
            self._devices = _devices()
        found: dict[int, float] = {}
        latest = self._since
        for device in self._devices:
            try:
                samples = pynvml.nvmlDeviceGetProcessUtilization(device, self._since)
            except pynvml.NVMLError:
                continue
            for sample in samples:
                found[sample.pid] = found.get(sample.pid, 0.0) + sample.smUtil
                latest = max(latest, sample.timeStamp)
        self._since = latest
        return found


def _devices() -> list[Any]:
    import pynvml

    try:
        pynvml.nvmlInit()
        return [pynvml.nvmlDeviceGetHandleByIndex(index) for index in range(pynvml.nvmlDeviceGetCount())]
    except pynvml.NVMLError:
        return []

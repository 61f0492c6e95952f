"""Division of the GPUs' energy among jobs."""

from collections.abc import Mapping
from typing import Any

from headway.energy.ledger import JobUsage


def gpu_shares(jobs: Mapping[str, JobUsage], utilization: Mapping[int, float]) -> dict[str, float]:
    """Return the share of the GPUs' energy of each job that uses a GPU. The shares sum to 1.

    Proportional to `utilization`, on any scale by process id. Equal shares if that is unknown, as in
    containers, where the driver's process ids differ. Empty if no job uses a GPU.
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
    """Reader of all NVIDIA GPUs' utilisation by process, through NVML."""

    def __init__(self) -> None:
        self._devices: list[Any] | None = None
        self._since = 0
        """Time of the newest sample, in NVML's unit: microseconds since 1970."""

    def read(self) -> dict[int, float]:
        """Return, by process id, the sum of multiprocessor-utilisation samples since the last call.

        Empty if NVML does not report it.
        """
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

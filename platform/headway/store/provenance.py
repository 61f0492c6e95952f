"""Provenance of a run: package versions, git revision, hardware."""

import platform
import re
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

import psutil

from headway.rollout.workers.usage import usable_cores

# Simulators included: another version may change every result.
_PACKAGES = (
    "headway",
    "numpy",
    "numba",
    "torch",
    "gymnasium",
    "pettingzoo",
    "supersuit",
    "mlflow-skinny",
    "codecarbon",
    "libsumo",
    "highway-env",
)
_GIT_SECONDS = 5.0
_CPU_INFO = Path("/proc/cpuinfo")
_VECTOR_UNIT = re.compile(r"sse4_\d|avx\w*|fma|f16c|amx\w*|asimd\w*|sve\w*")
"""Processor flags that decide which of their kernels numerical libraries choose, and so how sums round."""


def provenance() -> Mapping[str, str]:
    """Return package versions, git revision of the current folder and hardware, as tags of a run.

    Imports none of those packages; leaves out what cannot be determined.
    """
    return _provenance(Path.cwd())


@cache
def _provenance(project: Path) -> Mapping[str, str]:
    return _versions() | _revision(project) | _hardware()


def _versions() -> dict[str, str]:
    found = {"version.python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[f"version.{package}"] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _revision(project: Path) -> dict[str, str]:
    revision = _git(project, "rev-parse", "HEAD")
    if revision is None:
        return {}
    changes = _git(project, "status", "--porcelain", "--untracked-files=no")
    dirty = {} if changes is None else {"git.dirty": "true" if changes else "false"}
    return {"git.revision": revision, **dirty}


def _git(project: Path, *arguments: str) -> str | None:
    command = ["git", "--no-optional-locks", "-C", str(project), *arguments]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None


def _hardware() -> dict[str, str]:
    features = " ".join(sorted(filter(_VECTOR_UNIT.fullmatch, _cpu_info("flags", "Features").split())))
    found = {
        "hardware.cpu": _cpu_info("model name") or platform.processor() or platform.machine(),
        **({"hardware.cpu_features": features} if features else {}),
        "hardware.cores": str(usable_cores()),
        "hardware.memory_gib": f"{psutil.virtual_memory().total / 2**30:.1f}",
        "hardware.host": platform.node(),
        "hardware.system": platform.platform(),
    }
    gpus = _gpu_models()
    return found | ({"hardware.gpu": ", ".join(gpus)} if gpus else {})


def _cpu_info(*names: str) -> str:
    """Return the value of the first line with one of these names in Linux's description of its processors,
    of which the first stands for all; empty if there is none."""
    try:
        lines = _CPU_INFO.read_text().splitlines()
    except OSError:
        return ""
    pairs = (line.partition(":") for line in lines)
    return next((value.strip() for name, _, value in pairs if name.strip() in names), "")


def _gpu_models() -> list[str]:
    # Read from /proc: the NVML library would need an import and would initialise the driver.
    listings = sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))
    lines = (line for listing in listings for line in listing.read_text().splitlines())
    return [line.split(":", 1)[1].strip() for line in lines if line.startswith("Model:")]

"""CodeCarbon's tracker, set up to work offline, without output or files, and to measure only on request."""

import importlib.util
import json
import logging
import time
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from headway.config.experiment import EnergyConfig
from headway.contracts import HeadwayError

_NEVER = 10 * 365 * 86400.0
_ANY_COUNTRY = "FRA"
"""Placeholder, as CodeCarbon requires a country even if the CO2 is not used."""
_COUNTERS = {"intel_rapl": "RAPL", "windows_emi": "EMI", "intel_power_gadget": "Power Gadget"}
"""Name of the energy counter by CodeCarbon's CPU mode."""
NOT_MEASURED = "not measured"


class Readings:
    """Output handler of CodeCarbon, its public interface to the totals. Keeps the latest totals."""

    def __init__(self) -> None:
        self.count = 0
        self.time = 0.0
        """Time of the latest totals, by `time.monotonic`."""
        self._totals = self._reported = (0.0, 0.0, 0.0, 0.0)

    def out(self, total: Any, delta: Any) -> None:  # noqa: ANN401 - CodeCarbon's record
        """Store the totals. CodeCarbon calls this at each `flush` and `stop`."""
        self._totals = (total.cpu_energy, total.gpu_energy, total.ram_energy, total.emissions)
        self.time = time.monotonic()
        self.count += 1

    def live_out(self, total: Any, delta: Any) -> None:  # noqa: ANN401
        """Do nothing: without periodic measurements this is never called."""

    def task_out(self, data: Any, experiment_name: str) -> None:  # noqa: ANN401
        """Do nothing: without tasks this is never called."""

    def exit(self) -> None:
        """Do nothing. CodeCarbon calls this at the end."""

    def increment(self) -> tuple[float, float, float, float]:
        """Return kWh of CPU, GPU and RAM, and kg CO2eq, since the last call or the start."""
        cpu, gpu, ram, kg = (now - before for now, before in zip(self._totals, self._reported, strict=True))
        self._reported = self._totals
        return cpu, gpu, ram, kg


@dataclass(frozen=True)
class PowerModes:
    """Source of each part's power: `measured (...)`, `estimated (...)` or `not measured`."""

    cpu: str = NOT_MEASURED
    gpu: str = NOT_MEASURED
    ram: str = NOT_MEASURED

    def as_tags(self) -> dict[str, str]:
        """Return the tags of a run."""
        return {"energy.cpu": self.cpu, "energy.gpu": self.gpu, "energy.ram": self.ram}

    def notices(self) -> tuple[str, ...]:
        """Return one line per part that is not measured, except RAM, which never is."""
        lines = []
        if self.cpu == NOT_MEASURED:
            lines.append("the CPU's energy is not measured on this machine and is left out")
        elif not self.cpu.startswith("measured"):
            lines.append(
                f"the CPU's energy is {self.cpu}: its counters (RAPL) cannot be read here; the power at "
                "full load can be set by energy.cpu_power_w=WATTS"
            )
        if self.gpu == NOT_MEASURED and _has_gpu():
            lines.append("the GPU's energy is not measured (NVML does not answer) and is left out")
        return tuple(lines)


def make_tracker(config: EnergyConfig, readings: Readings) -> Any:  # noqa: ANN401 - CodeCarbon is not typed
    """Return a tracker that passes its totals to `readings` at each `flush`.

    All settings that concern network and disk are given explicitly, so that a user's CodeCarbon configuration
    file cannot switch them on. Its settings of the hardware (power, PUE) stay in effect.
    """
    from codecarbon import OfflineEmissionsTracker

    # The constructor logs warnings before it applies its log_level.
    logging.getLogger("codecarbon").setLevel(logging.CRITICAL)
    # Left out if unset: an explicit None would override the power in a CodeCarbon configuration file.
    power = {} if config.cpu_power_w is None else {"force_cpu_power": config.cpu_power_w}
    return OfflineEmissionsTracker(
        **power,
        country_iso_code=config.country or _ANY_COUNTRY,
        region=None,
        cloud_provider=None,
        cloud_region=None,
        country_2letter_iso_code=None,
        electricitymaps_api_token="",
        emissions_endpoint=None,
        output_methods=[],
        output_handlers=[readings],
        api_call_interval=-1,
        # CodeCarbon's own timer would measure in another thread and count some energy twice.
        measure_power_secs=_NEVER,
        tracking_mode="machine",
        allow_multiple_runs=True,
        log_level="critical",
    )


def power_modes(tracker: Any) -> PowerModes:  # noqa: ANN401
    """Return the power sources of a started tracker, from CodeCarbon's private hardware records."""
    modes = {}
    for part in getattr(tracker, "_hardware", ()):
        match type(part).__name__:
            case "RAM":
                modes["ram"] = "estimated (by size)"
            case "GPU":
                modes["gpu"] = "measured (NVML)"
            case "CPU":
                modes["cpu"] = _cpu_mode(part)
            case "AppleSiliconChip" | "Raspberry":
                modes[part.chip_part.lower()] = f"measured ({type(part).__name__})"
    return PowerModes(**modes)


def _cpu_mode(part: Any) -> str:  # noqa: ANN401
    mode = getattr(part, "_mode", "unknown")
    if mode in _COUNTERS:
        return f"measured ({_COUNTERS[mode]})"
    watts = getattr(part, "_tdp", None)
    power = f", {watts:g} W at full load" if isinstance(watts, int | float) else ""
    return f"estimated ({mode}{power})"


def check_country(country: str) -> None:
    """Raise HeadwayError for an unknown code, for which CodeCarbon would silently use the world's average."""
    package = importlib.util.find_spec("codecarbon")
    if package is None or not package.submodule_search_locations:
        return
    mix = Path(package.submodule_search_locations[0], "data/private_infra/global_energy_mix.json")
    if not mix.exists():
        return
    codes = json.loads(mix.read_text())
    if country in codes:
        return
    names = {str(entry.get("country_name", "")).lower(): code for code, entry in codes.items()}
    named = names.get(country.lower()) or (country.upper() if country.upper() in codes else None)
    near = named or next(iter(get_close_matches(country.upper(), codes, n=1)), None)
    hint = f"did you mean {near}?" if near else "write its ISO 3166-1 alpha-3 code, such as DEU, or null"
    raise HeadwayError(
        f"energy.country {country!r} is not the three-letter code of a country with a known energy "
        f"mix; {hint}"
    )


def _has_gpu() -> bool:
    return any(Path(sign).exists() for sign in ("/dev/nvidia0", "/dev/nvidiactl", "/dev/kfd"))

"""What all copies of one published bus environment share. Light: numpy and the kernel's records only."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.kernel.layout import SETTINGS, Network


@dataclass(frozen=True)
class Prepared:
    """A network and the configuration it was built for; picklable."""

    config: BusPublishedConfig
    network: Network
    lines: tuple[str, ...]
    """Line of each route (R)."""
    source: str
    """Where the scenario comes from, with its licence."""

    @property
    def agents(self) -> tuple[str, ...]:
        """One name a bus (N)."""
        return tuple(f"bus_{n}" for n in range(self.config.agents))

    @property
    def groups(self) -> tuple[str, ...]:
        """Each bus's line (N)."""
        return tuple(self.lines[n // self.config.agents_per_route] for n in range(self.config.agents))

    @property
    def settings(self) -> NDArray[Any]:
        """The configuration as one SETTINGS record, shape (1,)."""
        config, reward = self.config, self.config.reward
        scaled = config.observation == "scaled"
        values = {
            "start_s": config.start_hour * 3600.0,
            "end_s": config.end_hour * 3600.0,
            "weight_occupancy": reward.occupancy,
            "weight_uptime": reward.uptime,
            "weight_regularity": reward.regularity,
            "weight_efficiency": reward.efficiency,
            "low_occupancy": reward.low_occupancy,
            "high_occupancy": reward.high_occupancy,
            "target_headway_s": reward.target_headway_s,
            "demand_unit": max(float(self.network.demand.max()), 1.0) if scaled else 1.0,
            "stop_unit": max(len(self.network.demand) - 1.0, 1.0) if scaled else 1.0,
            "shared": reward.scope == "team",
            "max_steps": config.max_steps,
            "agents_per_route": config.agents_per_route,
        }
        settings = np.zeros(1, SETTINGS)
        for name, value in values.items():
            settings[name] = value
        return settings


def prepare(config: BusPublishedConfig) -> Prepared:
    """Read or generate the scenario and build its network, once, in the parent (imports pandas and scipy).

    Raises HeadwayError where the scenario cannot be used."""
    from headway_envs.bus.prepared import source_of
    from headway_envs.bus.scenario.source import scenario_tables
    from headway_envs.bus_published.network import build

    tables = scenario_tables(config.scenario, config.scenario_seed)
    network, lines = build(tables, config)
    return Prepared(config, network, lines, source_of(tables.meta))

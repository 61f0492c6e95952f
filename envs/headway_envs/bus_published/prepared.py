"""Data that all copies of a published bus environment share.

Imports only numpy and the kernel's records until `prepare` is called.
"""

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from headway_envs.array_env import record
from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.kernel.layout import SETTINGS, Network


@dataclass(frozen=True)
class Prepared:
    """Network and the configuration it was built for; picklable."""

    config: BusPublishedConfig
    network: Network
    source: str
    """Source of the scenario, with its licence if stated."""

    @property
    def agents(self) -> tuple[str, ...]:
        """(N,) name of each bus."""
        return tuple(f"bus_{n}" for n in range(self.config.agents))

    @property
    def settings(self) -> NDArray[Any]:
        """The configuration as one SETTINGS record, shape (1,)."""
        config, reward = self.config, self.config.reward
        scaled = config.observation == "scaled"
        given = {**vars(config), **vars(reward)}
        values = {name: given[name] for name in SETTINGS.fields or () if name in given} | {
            "start_s": config.start_hour * 3600.0,
            "end_s": config.end_hour * 3600.0,
            "weight_occupancy": reward.occupancy,
            "weight_uptime": reward.uptime,
            "weight_regularity": reward.regularity,
            "weight_efficiency": reward.efficiency,
            "demand_unit": max(float(self.network.demand.max()), 1.0) if scaled else 1.0,
            "stop_unit": max(len(self.network.demand) - 1.0, 1.0) if scaled else 1.0,
            "shared": reward.scope == "team",
        }
        return record(SETTINGS, values)


def prepare(config: BusPublishedConfig) -> Prepared:
    """Read or generate the scenario and build its network: once, in the parent process.

    Imports pandas and scipy.

    Raises HeadwayError for an unusable scenario.
    """
    from headway_envs.bus.prepare import source_of
    from headway_envs.bus.scenario.source import scenario_tables
    from headway_envs.bus_published.network import build

    tables = scenario_tables(config.scenario, config.scenario_seed)
    return Prepared(config, build(tables, config), source_of(tables.meta))

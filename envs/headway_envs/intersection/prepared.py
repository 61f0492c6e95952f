"""Data that all copies of an intersection share."""

from dataclasses import dataclass

from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.demand import routes_xml
from headway_envs.intersection.network import Network, network_file
from headway_envs.sumo_simulation import require_sumo


@dataclass(frozen=True)
class Prepared:
    """Configuration, network and demand; picklable. SUMO itself is loaded at the first reset."""

    config: IntersectionConfig
    network: Network
    routes: str
    """Content of the SUMO route file."""


def prepare(config: IntersectionConfig) -> Prepared:
    """Read the network and generate the demand. Raises HeadwayError if SUMO is not installed."""
    require_sumo()
    return Prepared(config, Network.read(network_file(config.junction)), routes_xml(config))

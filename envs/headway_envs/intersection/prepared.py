"""What all copies of an intersection share."""

from dataclasses import dataclass

from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.demand import routes_xml
from headway_envs.intersection.network import Network, network_file
from headway_envs.intersection.sumo.simulation import require_sumo


@dataclass(frozen=True)
class Prepared:
    """Picklable; SUMO itself is loaded by whoever begins an episode."""

    config: IntersectionConfig
    network: Network
    routes: str
    """Content of SUMO's route file."""


def prepare(config: IntersectionConfig) -> Prepared:
    """Read the network and write the demand. Raises HeadwayError where SUMO is not installed."""
    require_sumo()
    return Prepared(config, Network.read(network_file(config.junction)), routes_xml(config))

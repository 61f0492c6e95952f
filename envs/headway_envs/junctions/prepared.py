"""Data that all copies of an environment share."""

from dataclasses import dataclass

from headway.contracts import HeadwayError
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.demand import routes_xml
from headway_envs.junctions.files import Files
from headway_envs.junctions.network import Network
from headway_envs.sumo_simulation import require_sumo


@dataclass(frozen=True)
class Prepared:
    """Configuration, network and demand; picklable. SUMO itself is loaded at the first reset."""

    config: JunctionsConfig
    network: Network
    routes: tuple[str, ...]
    """Content of the SUMO route file of each demand."""
    notices: tuple[str, ...] = ()

    @property
    def approaches(self) -> int:
        """K: number of approaches that fit into an observation."""
        return self.config.approaches or self.network.others.shape[1] + 1


def prepare(config: JunctionsConfig) -> Prepared:
    """Read the network and the demand. Raises HeadwayError if they cannot be used or SUMO is not
    installed."""
    require_sumo()
    files = Files.of(config)
    network = Network.read(files.network)
    most = network.others.shape[1] + 1
    if config.approaches is not None and config.approaches < most:
        raise HeadwayError(
            f"env.args.approaches must be at least {most} for network {config.network}, the number of lanes "
            f"towards one of its junctions, not {config.approaches}"
        )
    return Prepared(config, network, routes_xml(config, network, files.demands), files.notices)

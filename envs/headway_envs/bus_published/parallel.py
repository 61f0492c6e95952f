"""PettingZoo ParallelEnv of the published bus environment."""

from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.env import BusPublishedBatchedEnv
from headway_envs.bus_published.prepared import Prepared, prepare
from headway_envs.parallel_env import ParallelEnvBase


def parallel_env(config: BusPublishedConfig | Prepared) -> ParallelEnvBase:
    """Return one copy as a ParallelEnv, made from a configuration or from the result of `prepare`."""
    prepared = prepare(config) if isinstance(config, BusPublishedConfig) else config
    scaled = prepared.config.observation == "scaled"
    return ParallelEnvBase(
        lambda copies: BusPublishedBatchedEnv(prepared, copies),
        name="headway_bus_published_v0",
        bound=1.0 if scaled else float("inf"),
        low=0.0,
    )

"""PettingZoo ParallelEnv of the merging environments."""

from headway_envs.merge.config import MergeConfig
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.prepared import Prepared, prepare
from headway_envs.parallel_env import ParallelEnvBase


def parallel_env(config: MergeConfig | Prepared, ramp_lanes: int) -> ParallelEnvBase:
    """Return one copy as a ParallelEnv, made from a configuration or from the result of `prepare`."""
    prepared = prepare(config, ramp_lanes) if isinstance(config, MergeConfig) else config
    return ParallelEnvBase(lambda copies: MergeBatchedEnv(prepared, copies))

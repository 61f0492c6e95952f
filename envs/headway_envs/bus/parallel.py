"""PettingZoo ParallelEnv of the bus environment: a batch of one copy."""

import numpy as np

from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.prepared import Prepared
from headway_envs.parallel_env import ParallelEnvBase

_BOUND = 5.0
"""Bound on the absolute value of each component of the observation `control`, except the number of the
pattern, which is below that of the line's patterns. Those of `paper` and `published` lie in [0, 1]."""


class BusParallelEnv(ParallelEnvBase):
    """Service days as a ParallelEnv.

    Every slot stays in `agents` all day. Each agent's `info` holds `alive`, `acting` and `action_mask` and,
    at the end, `episode_metrics` by name. A seed gives the same days as `BusBatchedEnv.reset([seed])`.
    """

    def __init__(self, config: BusConfig | Prepared | None = None) -> None:
        if isinstance(config, Prepared):
            prepared = config
        else:
            # Workers pass a Prepared: they must not import pandas, as `prepare` may do.
            from headway_envs.bus.prepare import prepare

            prepared = prepare(config or BusConfig())
        patterns = int(np.diff(prepared.network.line_patterns).max())
        wide = prepared.config.observation in ("control", "network")
        super().__init__(
            lambda copies: BusBatchedEnv(prepared, copies),
            name="headway_bus_v0",
            bound=max(_BOUND, patterns - 1.0) if wide else 1.0,
            low=None if wide else 0.0,
        )

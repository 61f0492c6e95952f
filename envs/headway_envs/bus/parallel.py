"""The PettingZoo face of the bus environment: a batch of one copy."""

from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.prepared import Prepared, prepare
from headway_envs.parallel_face import ParallelFace

_BOUND = 5.0
"""Of every component of the observation `control`; those of the others lie in [0, 1]."""


class BusParallelEnv(ParallelFace):
    """One service day as a ParallelEnv. Every slot stays in `agents` all day; `info` of each agent carries
    `alive`, `acting`, `action_mask`, and at the end `episode_metrics`, by name. The same seed gives the
    same days as `BusBatchedEnv.reset([seed])`."""

    def __init__(self, config: BusConfig | Prepared | None = None) -> None:
        prepared = config if isinstance(config, Prepared) else prepare(config or BusConfig())
        wide = prepared.config.observation == "control"
        super().__init__(
            lambda copies: BusBatchedEnv(prepared, copies),
            name="headway_bus_v0",
            bound=_BOUND if wide else 1.0,
            low=None if wide else 0.0,
        )

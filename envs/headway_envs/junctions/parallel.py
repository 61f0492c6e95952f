"""PettingZoo ParallelEnv of the junctions, with slots as agents."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.env import JunctionsBatchedEnv
from headway_envs.junctions.prepared import Prepared, prepare
from headway_envs.slots_env import SlotsParallelEnv


class JunctionsSlotsParallelEnv(SlotsParallelEnv):
    """The junctions as a ParallelEnv."""

    render_mode = "rgb_array"
    _env: JunctionsBatchedEnv

    def __init__(self, config: JunctionsConfig | Prepared | None = None) -> None:
        prepared = config if isinstance(config, Prepared) else prepare(config or JunctionsConfig())
        super().__init__(
            lambda copies: JunctionsBatchedEnv(prepared, copies), name="headway_junctions_v0", bound=1.0
        )

    def render(self) -> NDArray[np.uint8]:
        """Return an RGB picture of the current state, (height, width, 3)."""
        from headway_envs.junctions.renderer import JunctionsRenderer

        return JunctionsRenderer(self._env.prepared).render(self._env, at_end=False)

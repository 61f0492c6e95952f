"""PettingZoo ParallelEnv of the intersection, with slots as agents."""

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.env import IntersectionBatchedEnv
from headway_envs.intersection.prepared import Prepared, prepare
from headway_envs.slots_env import SlotsParallelEnv

BOUND = 5.0
"""Declared bound on the components of an observation."""


class IntersectionSlotsParallelEnv(SlotsParallelEnv):
    """The intersection as a ParallelEnv."""

    render_mode = "rgb_array"
    _env: IntersectionBatchedEnv

    def __init__(self, config: IntersectionConfig | Prepared | None = None) -> None:
        prepared = config if isinstance(config, Prepared) else prepare(config or IntersectionConfig())
        super().__init__(
            lambda copies: IntersectionBatchedEnv(prepared, copies),
            name="headway_intersection_v0",
            bound=BOUND,
        )

    def render(self) -> NDArray[np.uint8]:
        """Return an RGB picture of the current state, (height, width, 3)."""
        from headway_envs.intersection.renderer import frame_of, render

        return render(frame_of(self._env))

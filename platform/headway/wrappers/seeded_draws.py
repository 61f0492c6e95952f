"""Random numbers for SuperSuit's frame_skip_v0."""

from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper


class SeededDraws(BaseParallelWrapper):  # type: ignore[misc]  # pettingzoo's types are skipped: see pyproject.toml
    """Gives an environment without the attribute `np_random` one, from the seed of every reset.

    SuperSuit's frame skip draws the number of frames from it, even a constant one, but few environments have
    it.
    """

    def __init__(self, env: ParallelEnv) -> None:
        super().__init__(env)
        self._lacking = not hasattr(env.unwrapped, "np_random")

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        if self._lacking:
            self.env.unwrapped.np_random = np.random.default_rng(seed)
        observations, infos = self.env.reset(seed=seed, options=options)
        return observations, infos

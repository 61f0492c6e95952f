"""Wrappers that remember observations, for slots that several agents hold in turn."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pettingzoo.utils import BaseParallelWrapper


class SlotStreams(BaseParallelWrapper):  # type: ignore[misc]  # pettingzoo's types are skipped: see pyproject.toml
    """Lets a wrapper of SuperSuit forget the observations of an agent that has left its slot (`slot_ended`).

    The next agent in the slot would otherwise observe them as its own. The slot counts as empty in that step:
    zeros.
    """

    def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
        *rest, infos = self.env.step(actions)
        for agent, info in infos.items():
            if "slot_ended" in info:
                modifier = self.env.modifiers[agent]
                modifier.reset()
                modifier.modify_obs(np.zeros_like(self.env.env.observation_space(agent).low))
        return (*rest, infos)

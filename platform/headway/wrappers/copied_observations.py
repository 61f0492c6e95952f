"""Observations that keep their values after later steps."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pettingzoo.utils import BaseParallelWrapper


class CopiedObservations(BaseParallelWrapper):  # type: ignore[misc]  # pettingzoo's types are skipped: see pyproject.toml
    """Returns copies of all observations.

    SuperSuit's frame stack and many environments overwrite the previous observation in place. A wrapper that
    stores observations, such as delay_observations_v0, would then store the newest one several times.
    """

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        observations, infos = self.env.reset(seed=seed, options=options)
        return _copied(observations), infos

    def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
        observations, *rest = self.env.step(actions)
        return (_copied(observations), *rest)


def _copied(observations: Mapping[str, Any]) -> dict[str, Any]:
    return {agent: np.array(observation) for agent, observation in observations.items()}

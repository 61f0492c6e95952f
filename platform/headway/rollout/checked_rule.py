"""Check of a rule's actions: many environments compute with invalid ones instead of refusing them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    ActionSpace,
    BatchedEnv,
    Box,
    Discrete,
    HeadwayError,
    MultiDiscrete,
    Observations,
    Rule,
)


@dataclass(frozen=True)
class CheckedRule:
    """A rule whose actions are checked in every step."""

    name: str
    rule: Rule

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """Return the rule's actions. Raises HeadwayError if the action of a live agent is invalid.

        Those of a Box need only be finite, since environments clip them.
        """
        actions = np.asarray(self.rule.act(env, observed))
        if problem := _problem(actions, env.spec.action_space, observed.alive):
            raise HeadwayError(f"rule {self.name} returned {problem}; correct the rule")
        return actions


def _problem(actions: NDArray[Any], space: ActionSpace, alive: NDArray[np.bool_]) -> str | None:
    """Return what is wrong with the actions of agents (C, N); None if nothing is."""
    match space:
        case Box():
            kinds, name = "iuf", "a Box has finite numbers"
        case Discrete(n=n):
            kinds, name = "biu", f"Discrete({n}) has 0 to {n - 1}"
        case MultiDiscrete(nvec=nvec):
            kinds, name = "biu", f"MultiDiscrete{nvec} counts from 0"
    if actions.shape != (shape := (*alive.shape, *space.shape)):
        return f"actions of shape {actions.shape}, not {shape}"
    if actions.dtype.kind not in kinds:
        return f"actions of type {actions.dtype}; {name}"
    if isinstance(space, Box):
        wrong = ~np.isfinite(actions)
    else:
        wrong = (actions < 0) | (actions >= space.options)
    if not wrong.any():
        return None
    wrong &= alive.reshape(*alive.shape, *[1] * len(space.shape))
    return f"action {actions[wrong][0]}; {name}" if wrong.any() else None

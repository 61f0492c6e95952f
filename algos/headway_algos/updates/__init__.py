"""How policies are improved from advantages: each update by name, with the state that it alone keeps."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from headway_algos.actor import Actor
from headway_algos.config import AlgoConfig
from headway_algos.experience import Layout
from headway_algos.policy_rows import PolicyRows
from headway_algos.updates.ppo import PPO


class Update(Protocol):
    """Improves a stack of policies in place, each by itself. Whatever it carries from one improvement to
    the next (moments of an optimiser, adaptive coefficients) is its own, and in its state."""

    def improve(
        self, rows: PolicyRows, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Move the policies along advantages (P, B), used as they come; generators (P,), for shuffling.

        Policies without a selected row stay as they were: an order that gives agents turns narrows
        `selected` to those whose turn it is. Returns info, each (P,).
        """
        ...

    def anneal(self, share: float) -> None:
        """Take steps of `share` of their configured size from now on."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that it carries on, the policies excepted: tensors, numbers, strings, lists and dicts."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; leaves `state` as it is."""
        ...


UPDATES: dict[str, Callable[[Actor, AlgoConfig, Layout], Update]] = {"ppo": PPO}

"""In what order a team's policies are improved."""

from collections.abc import Callable, Sequence

import numpy as np
from torch import Tensor

from headway_algos.policy_rows import PolicyRows
from headway_algos.updates import Update

Order = Callable[[Update, PolicyRows, Tensor, Sequence[np.random.Generator]], dict[str, Tensor]]
"""(update, rows, advantages (P, B), generators (P,)) -> info, each (P,); changes the policies."""


def simultaneous(
    update: Update, rows: PolicyRows, advantages: Tensor, generators: Sequence[np.random.Generator]
) -> dict[str, Tensor]:
    """All policies at once, each against the others as they were."""
    return update.improve(rows, advantages, generators)


ORDERS: dict[str, Order] = {"simultaneous": simultaneous}

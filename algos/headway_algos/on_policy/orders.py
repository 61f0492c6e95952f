"""An order in which a team's policies are updated, and the common one: all at once."""

from collections.abc import Callable, Sequence

import numpy as np
from torch import Tensor

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.grouping import Grouping
from headway_algos.on_policy.updates import Update

Order = Callable[
    [Update, Grouping, PolicyBatch, Tensor, Sequence[np.random.Generator], Sequence[np.random.Generator]],
    dict[str, Tensor],
]
"""(update, grouping, rows, advantages (P, B), generators for shuffling (P,), generators for the order (R,))
-> metrics by name, each (P,). Updates the policies in place."""


def simultaneous(
    update: Update,
    grouping: Grouping,
    rows: PolicyBatch,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """Update all policies at once, on advantages of the policies that acted."""
    return update.improve(rows, advantages, generators)

"""Policy updates. The package itself imports no torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, Self, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from torch import Tensor

    from headway_algos.batches.layout import Layout
    from headway_algos.batches.policy_batch import PolicyBatch
    from headway_algos.config import AlgoConfig
    from headway_algos.networks.actor import Actor


class Update(Protocol):
    """Updates a stack of policies in place and independently.

    Its state is everything carried between updates, such as moments of an optimiser or adaptive coefficients.
    """

    actor: Actor
    config: AlgoConfig

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        """Update the policies; return metrics, each (P,), NaN for policies without a selected row.

        `advantages` (P, B) are used as given: the caller standardises them if configured. `generators` (P,)
        are for shuffling and sampling. Recurrent policies need `rows.sequences`. Policies without a selected
        row, and their state, stay unchanged.
        """
        ...

    def anneal(self, share: float) -> None:
        """Scale steps to `share` of their configured size."""
        ...

    def narrow(self, policies: Tensor) -> Self:
        """Return a copy of this update that holds only `policies` (n,) and their state.

        The sequential order updates such a copy, then calls `adopt`.
        """
        ...

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy `policies` (n,) and their state from `part`, a result of `narrow`."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return the state, without the policies: tensors, numbers, strings, lists and dicts."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`, leaving `state` unchanged."""
        ...


MakeUpdate: TypeAlias = "Callable[[Actor, Any, Layout], Update]"
"""(actor, config, layout) -> update."""

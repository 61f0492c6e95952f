"""The decisions of a rule from which policies learn to imitate it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.networks.normalisation import RunningStatistics

CAPACITY = 200_000
"""Most decisions that are kept per policy."""


class RuleDecisions:
    """A sample of a rule's decisions for each of P policies.

    The last `CAPACITY` would show one part of an episode too often: every decision is kept with the same
    probability, by random keys of which the smallest stay.
    """

    def __init__(self, policies: int) -> None:
        self.kept: list[dict[str, Tensor]] = [{} for _ in range(policies)]

    def include(self, rows: PolicyBatch, generators: Sequence[np.random.Generator]) -> None:
        """Include the selected rows, whose observations are not normalised. `generators`: one per policy."""
        columns = {"observations": rows.observations, "actions": rows.actions}
        if rows.masks is not None:
            columns["masks"] = rows.masks
        for place, (random, selected) in enumerate(zip(generators, rows.selected, strict=True)):
            chosen = torch.from_numpy(np.flatnonzero(selected))
            new = {name: column[place][chosen.to(column.device)].cpu() for name, column in columns.items()}
            new["keys"] = torch.from_numpy(random.random(len(chosen)))
            kept = self.kept[place]
            both = {name: torch.cat((kept[name], new[name])) if kept else new[name] for name in new}
            if len(both["keys"]) > CAPACITY:
                smallest = both["keys"].topk(CAPACITY, largest=False).indices.sort().values
                both = {name: column[smallest] for name, column in both.items()}
            self.kept[place] = both

    def rows(self, moments: RunningStatistics | None, device: torch.device) -> PolicyBatch:
        """Return the decisions, padded to the longest policy's; `moments` normalise the observations."""
        counts = np.array([len(kept["keys"]) for kept in self.kept])

        def padded(name: str) -> Tensor:
            parts = [kept[name] for kept in self.kept]
            return torch.nn.utils.rnn.pad_sequence(parts, batch_first=True).to(device)

        observations = padded("observations")
        if moments is not None:
            observations = moments.normalised(observations)
        selected: NDArray[np.bool_] = np.arange(counts.max()) < counts[:, None]
        masks = None
        if "masks" in self.kept[0]:
            masks = padded("masks") | torch.from_numpy(~selected).to(device)[..., None]
        actions = padded("actions")
        log_probs = observations.new_zeros(selected.shape)
        return PolicyBatch(observations, masks, actions, log_probs, selected)

    def state(self) -> list[dict[str, Tensor]]:
        """Return what `load_state` takes."""
        return self.kept

    def load_state(self, state: Sequence[dict[str, Any]]) -> None:
        """Go on with the decisions that `state` returned."""
        self.kept = [dict(kept) for kept in state]

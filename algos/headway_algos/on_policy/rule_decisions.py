"""The decisions of a rule from which policies learn to imitate it."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.networks.normalisation import RunningStatistics

CAPACITY, LEAST = 30_000_000, 5_000
"""Maximum number of values in the observations kept per seed (120 MB in float32), divided equally among its
policies, and the minimum number of decisions per policy. As many as possible are kept, since rare decisions
limit how well policies imitate: a bus goes to service about once per day."""


class RuleDecisions:
    """A uniform sample of a rule's decisions for each of P = R x K policies.

    The latest decisions alone would over-represent one part of an episode. Therefore each decision gets a
    random key, and the decisions with the smallest keys are kept.
    """

    def __init__(self, replicas: int, policies: int, observation_size: int) -> None:
        """`replicas`: number R of seeds; `policies`: number K per seed; `observation_size`: D."""
        self.capacity = max(CAPACITY // (policies * observation_size), LEAST)
        self.kept: list[dict[str, Tensor]] = [{} for _ in range(replicas * policies)]
        """The sample, which is all state: columns by name for each policy; empty before any decision."""

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
            if len(both["keys"]) > self.capacity:
                smallest = both["keys"].topk(self.capacity, largest=False).indices.sort().values
                both = {name: column[smallest] for name, column in both.items()}
            self.kept[place] = both

    def rows(self, moments: RunningStatistics | None, device: torch.device) -> PolicyBatch:
        """Return the decisions, padded to the largest number of any policy; `moments` normalise the
        observations."""
        counts = np.array([len(kept["keys"]) for kept in self.kept])
        longest = max(counts.max(), 1)

        def padded(name: str) -> Tensor:
            parts = [kept[name] for kept in self.kept]
            rows = parts[0].new_zeros((len(parts), longest, *parts[0].shape[1:]))
            for row, part in zip(rows, parts, strict=True):
                row[: len(part)] = part
            return rows.to(device)

        observations = padded("observations")
        if moments is not None:
            observations = moments.normalised(observations)
        selected: NDArray[np.bool_] = np.arange(longest) < counts[:, None]
        masks = None
        if "masks" in self.kept[0]:
            masks = padded("masks") | torch.from_numpy(~selected).to(device)[..., None]
        actions = padded("actions")
        log_probs = observations.new_zeros(selected.shape)
        return PolicyBatch(observations, masks, actions, log_probs, selected)

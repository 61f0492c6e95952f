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
        self._parts: list[list[dict[str, Tensor]]] = [[] for _ in range(replicas * policies)]
        """Columns by name for each policy, in parts that are joined when they exceed the capacity by far."""

    @property
    def kept(self) -> list[dict[str, Tensor]]:
        """The sample, which is all state: columns by name for each policy; empty before any decision."""
        for place in range(len(self._parts)):
            self._join(place)
        return [parts[0] if parts else {} for parts in self._parts]

    @kept.setter
    def kept(self, kept: Sequence[dict[str, Tensor]]) -> None:
        self._parts = [[part] if part else [] for part in kept]

    def include(self, rows: PolicyBatch, generators: Sequence[np.random.Generator]) -> None:
        """Include the selected rows, whose observations are not normalised. `generators`: one per policy."""
        columns = {"observations": rows.observations, "actions": rows.actions}
        if rows.masks is not None:
            columns["masks"] = rows.masks
        for place, (random, selected) in enumerate(zip(generators, rows.selected, strict=True)):
            chosen = torch.from_numpy(np.flatnonzero(selected))
            new = {name: column[place][chosen.to(column.device)].cpu() for name, column in columns.items()}
            new["keys"] = torch.from_numpy(random.random(len(chosen)))
            self._parts[place].append(new)
            if sum(len(part["keys"]) for part in self._parts[place]) > 1.25 * self.capacity:
                self._join(place)

    def _join(self, place: int) -> None:
        """Join the parts of one policy; keep the decisions with the smallest keys, up to the capacity."""
        parts = self._parts[place]
        if not parts:
            return
        joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        if len(joined["keys"]) > self.capacity:
            smallest = joined["keys"].topk(self.capacity, largest=False).indices.sort().values
            joined = {name: column[smallest] for name, column in joined.items()}
        self._parts[place] = [joined]

    def rows(self, moments: RunningStatistics | None, device: torch.device) -> PolicyBatch:
        """Return the decisions, padded to the largest number of any policy; `moments` normalise the
        observations."""
        sample = self.kept
        counts = np.array([len(kept["keys"]) for kept in sample])
        longest = max(counts.max(), 1)

        def padded(name: str) -> Tensor:
            parts = [kept[name] for kept in sample]
            rows = parts[0].new_zeros((len(parts), longest, *parts[0].shape[1:]))
            for row, part in zip(rows, parts, strict=True):
                row[: len(part)] = part
            return rows.to(device)

        observations = padded("observations")
        if moments is not None:
            observations = moments.normalised(observations)
        selected: NDArray[np.bool_] = np.arange(longest) < counts[:, None]
        masks = None
        if "masks" in sample[0]:
            masks = padded("masks") | torch.from_numpy(~selected).to(device)[..., None]
        actions = padded("actions")
        log_probs = observations.new_zeros(selected.shape)
        return PolicyBatch(observations, masks, actions, log_probs, selected)

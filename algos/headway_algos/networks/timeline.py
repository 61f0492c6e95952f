"""The order of rows in time, as networks with memory need it."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor


@dataclass(frozen=True)
class Timeline:
    """n sequences of L steps for each of P networks, side by side: rows are (P, L x n), step after step.

    A network without memory takes no notice of it.
    """

    hidden: Tensor
    """(P, M, n): what is remembered before the first step."""
    continues: Tensor | None = None
    """(P, 1, L x n): 0 where a stream begins, before which nothing is remembered, else 1; None: all 1."""
    keeps: Tensor | None = None
    """(P, 1, L x n) bool: the row changes what is remembered; None: every row does."""

    @classmethod
    def of_rows(cls, hidden: Tensor) -> Self:
        """Of rows (P, B) that have nothing to do with each other, each with its own memory (P, B, M)."""
        return cls(hidden.transpose(1, 2))

    def part(self, sequences: slice, policies: slice | Tensor) -> Self:
        """That of some of the sequences, of some of the networks."""
        count = self.hidden.shape[2]

        def cut(rows: Tensor | None) -> Tensor | None:
            if rows is None:
                return None
            chosen = rows[policies]
            by_step = chosen.view(*chosen.shape[:2], rows.shape[2] // max(count, 1), count)
            return by_step[..., sequences].flatten(2)

        return type(self)(self.hidden[policies][..., sequences], cut(self.continues), cut(self.keeps))


def reset_hidden(hidden: Tensor, continues: Tensor | None) -> Tensor:
    """What is remembered (P, M, n) before a step at which some streams begin (P, 1, n)."""
    return hidden if continues is None else hidden * continues


def hold_hidden(before: Tensor, after: Tensor, keeps: Tensor | None) -> Tensor:
    """What is remembered (P, M, n) after a step that not all sequences keep (P, 1, n)."""
    return after if keeps is None else torch.where(keeps, after, before)

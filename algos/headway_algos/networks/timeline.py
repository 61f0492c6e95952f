"""Order of rows in time, for recurrent networks."""

from dataclasses import dataclass
from typing import Self

from torch import Tensor


@dataclass(frozen=True)
class Timeline:
    """Order of rows (P, L x n) as n sequences of L steps, step-major, for each of P networks."""

    hidden: Tensor
    """(P, M, n): hidden states before the first step."""
    continues: Tensor | None = None
    """(P, 1, L x n): 0 where a stream begins, which resets the hidden state, else 1; None: all 1."""
    keeps: Tensor | None = None
    """(P, 1, L x n) bool: the row updates the hidden state; None: every row does."""

    @classmethod
    def of_rows(cls, hidden: Tensor) -> Self:
        """Return B sequences of one step, with hidden states (P, B, M)."""
        return cls(hidden.transpose(1, 2))

    def part(self, sequences: slice, policies: slice | Tensor) -> Self:
        """Return the timeline of the given sequences and networks."""
        count = self.hidden.shape[2]

        def cut(rows: Tensor | None) -> Tensor | None:
            if rows is None:
                return None
            chosen = rows[policies]
            by_step = chosen.view(*chosen.shape[:2], rows.shape[2] // max(count, 1), count)
            return by_step[..., sequences].flatten(2)

        return type(self)(self.hidden[policies][..., sequences], cut(self.continues), cut(self.keeps))

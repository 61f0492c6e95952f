"""How long an answer may take, judged by the time that earlier ones took."""

from dataclasses import dataclass
from math import inf

LEAST_S = 60.0
"""Shortest limit that is derived from earlier answers, s."""
_FACTOR = 10.0


@dataclass
class Pace:
    """The longest time that an answer took so far, and the limit for the next."""

    fixed_s: float | None = None
    """The limit, s; None: it is derived."""
    longest_s: float = 0.0
    """0: no answer yet."""

    def add(self, seconds: float) -> None:
        """Include the time that an answer took."""
        self.longest_s = max(self.longest_s, seconds)

    @property
    def limit_s(self) -> float:
        """Ten times the longest time so far, at least a minute; infinity before the first answer."""
        if self.fixed_s is not None:
            return self.fixed_s
        return max(LEAST_S, _FACTOR * self.longest_s) if self.longest_s else inf

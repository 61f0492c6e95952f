"""Limits on waiting that follow how long earlier waits took."""

from dataclasses import dataclass
from math import inf

MIN_TIMEOUT_S = 60.0
"""Shortest limit that is derived from earlier waits, s."""
START_TIMEOUT_S = 900.0
"""Limit on making or restoring environments, s, for which there are no earlier waits."""


@dataclass
class AdaptiveTimeout:
    """The longest wait so far, and the limit for the next."""

    fixed_s: float | None = None
    """The limit, s; None: it is derived."""
    factor: float = 10.0
    """Derived limit as a multiple of the longest wait."""
    min_s: float = MIN_TIMEOUT_S
    """Shortest derived limit, s."""
    longest_s: float = 0.0
    """Longest wait so far, s; 0: none yet."""

    def add(self, seconds: float) -> None:
        """Include a wait."""
        self.longest_s = max(self.longest_s, seconds)

    @property
    def limit_s(self) -> float:
        """The limit, s; infinity before the first wait."""
        if self.fixed_s is not None:
            return self.fixed_s
        return max(self.min_s, self.factor * self.longest_s) if self.longest_s else inf

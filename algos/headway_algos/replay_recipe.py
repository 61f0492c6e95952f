"""Definition of an off-policy algorithm by a record. Imports no torch."""

from dataclasses import dataclass

from headway.contracts import Box, Discrete, Lazy
from headway_algos.replay_config import ReplayConfig


@dataclass(frozen=True)
class ReplayRecipe:
    """An off-policy algorithm: its record and its method of learning from replayed transitions."""

    name: str
    summary: str
    """One line for `headway list algos`."""
    source: str
    """Paper, with its arXiv number."""
    config: type[ReplayConfig]
    actions: type[Discrete] | type[Box]
    """Action space required, which also decides how the algorithm explores."""
    make_method: Lazy
    """A `headway_algos.off_policy.learner.MakeMethod`."""

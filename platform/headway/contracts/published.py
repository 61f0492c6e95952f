"""Records of published results, which are stored in the package of their environment."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class PublishedResult:
    """Results that a publication reports for one algorithm, in the units of the environment's metrics."""

    values: Mapping[str, float] = field(default_factory=dict)
    """Printed numbers by metric; a metric without a number is absent."""
    ranges: Mapping[str, str] = field(default_factory=dict)
    """Ranges stated in words, by metric, for results that are only plotted."""
    finding: str = ""
    """The publication's conclusion about the algorithm, in a few words."""
    label: str = ""
    """The publication's name of the algorithm if it differs from Headway's."""


@dataclass(frozen=True)
class PublishedResults:
    """Results that one publication reports for an environment; `headway report` compares runs with them."""

    source: str
    """The publication and the tables or figures that the numbers were taken from."""
    results: Mapping[str, PublishedResult]
    """Results by Headway's name of the algorithm, in the order of the publication."""
    seeds: int = 1
    """Training runs per algorithm."""
    caveats: tuple[str, ...] = ()
    """Known differences from Headway's runs, one paragraph each, printed below the comparison; text between
    backquotes is code."""

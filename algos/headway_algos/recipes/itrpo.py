"""ITRPO: independent trust-region policy optimisation.

Every agent a takes one step that solves, to second order,

    maximise E[pi_a(u|o) / pi_old(u|o) A]   subject to   E[KL(pi_old || pi_a)] <= delta

(Schulman et al. 2015, arXiv:1502.05477, equation 14) with advantages from a critic V(o) of its own
observation, as if the other agents were part of the environment. An entropy bonus, where there is one, is
part of what is maximised.

Neighbours: IPPO replaces the constraint by a clip and many small steps; MATRPO replaces V(o) by V(s).
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "independent TRPO: local critic, natural gradient in a trust region, all agents at once"
SOURCE = "Schulman et al. 2015, arXiv:1502.05477"


@dataclass(frozen=True)
class ITRPOConfig(AlgoConfig):
    """ITRPO is local critic x TRPO x simultaneous."""

    name: str = "itrpo"
    critic: Literal["local"] = "local"
    """V(o) of an agent's own observation. With V(s) it is algo=matrpo; algo=custom takes any critic."""
    update: Literal["trpo"] = "trpo"
    """Trust-region policy optimisation. algo=custom takes any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom takes any order."""

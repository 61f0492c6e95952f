"""HATRPO: heterogeneous-agent trust-region policy optimisation.

Agents improve one after another, in an order i_1 ... i_N drawn anew at each update. With V(s) of the global
state and its advantage A, agent i_m takes TRPO's step on

    M A,   M = product over j < m of pi_new^{i_j}(u|o) / pi_old^{i_j}(u|o)

within its own bound of the mean KL (Kuba et al. 2022, arXiv:2109.11251, section 4.1). An agent whose line
search finds no step keeps its policy, and its ratio is 1. Each agent has a policy of its own, or each group
one (`policies: groups`), whose agents have their turn together.

Neighbours: MATRPO has M = 1, all agents at once; HAPPO replaces the trust region by PPO's clip.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "TRPO with a central critic, one agent after another, each weighed by those before it"
SOURCE = "Kuba et al. 2022, arXiv:2109.11251"


@dataclass(frozen=True)
class HATRPOConfig(AlgoConfig):
    """HATRPO is central critic x TRPO x sequential."""

    name: str = "hatrpo"
    critic: Literal["central"] = "central"
    """V(s) of the global state. algo=custom takes any critic."""
    update: Literal["trpo"] = "trpo"
    """Trust-region policy optimisation. With PPO it is algo=happo; algo=custom takes any update."""
    order: Literal["sequential"] = "sequential"
    """One agent after another; all at once it is algo=matrpo. algo=custom takes any order."""

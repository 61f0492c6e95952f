"""MATRPO: trust-region policy optimisation with a central critic.

Decentralised policies pi_a(u|o) take TRPO's step, as in ITRPO. Advantages come from a critic V(s) of the
global state, used in training only. This is MATRPO as MARLlib defines it (Hu et al. 2023, arXiv:2210.13708).
The algorithm of Li and He (2020, arXiv:2010.07916) has the same name but differs: its agents agree on the
joint step by exchanging messages.

Related: ITRPO's critic sees only o; MAPPO replaces the trust region by a clip; HATRPO updates the agents one
after another and weights advantages by the probability ratios of the agents updated before.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "TRPO with a central critic of the global state, all agents at once"
SOURCE = "Schulman et al. 2015, arXiv:1502.05477, with the critic of Yu et al. 2022, arXiv:2103.01955"


@dataclass(frozen=True)
class MATRPOConfig(AlgoConfig):
    """MATRPO: central critic, TRPO update, simultaneous order."""

    name: str = "matrpo"
    critic: Literal["central"] = "central"
    """V(s) of the global state. For V(o): algo=itrpo; algo=custom accepts any critic."""
    update: Literal["trpo"] = "trpo"
    """Trust-region policy optimisation. algo=custom accepts any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. One after another: algo=hatrpo; algo=custom accepts any order."""

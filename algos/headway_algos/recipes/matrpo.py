"""MATRPO: trust-region policy optimisation with a central critic.

Policies pi_a(u|o) stay decentralised and take TRPO's step, as in ITRPO; the advantages come from a critic
V(s) of the global state, used in training only. This is what the benchmark of MARLlib (Hu et al. 2023,
arXiv:2210.13708) calls MATRPO. Li and He (2020, arXiv:2010.07916) gave that name to another algorithm, in
which agents agree on the joint step by messages.

Neighbours: ITRPO's critic sees only o; MAPPO replaces the trust region by a clip; HATRPO updates the agents
one after another and weighs each one's advantages by the others' ratios.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "TRPO with a central critic of the global state, all agents at once"
SOURCE = "Schulman et al. 2015, arXiv:1502.05477, with the critic of Yu et al. 2022, arXiv:2103.01955"


@dataclass(frozen=True)
class MATRPOConfig(AlgoConfig):
    """MATRPO is central critic x TRPO x simultaneous."""

    name: str = "matrpo"
    critic: Literal["central"] = "central"
    """V(s) of the global state. With V(o) it is algo=itrpo; algo=custom takes any critic."""
    update: Literal["trpo"] = "trpo"
    """Trust-region policy optimisation. algo=custom takes any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once; one after another it is algo=hatrpo. algo=custom takes any order."""

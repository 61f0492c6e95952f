"""MAPPO: multi-agent proximal policy optimisation with a central critic.

Policies pi_a(u|o) stay decentralised and are improved by PPO's clipped surrogate, as in IPPO; the
advantages come from a critic V(s) of the global state, used in training only (Yu et al. 2022,
arXiv:2103.01955). With a shared team reward there is one V(s) for the whole team, so that all agents
are credited with the same advantage; with own rewards each policy has its own.

Neighbours: IPPO's critic sees only o; MAA2C takes one plain gradient step; HAPPO updates the agents one
after another and weighs each one's advantages by the others' ratios.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "PPO with a central critic of the global state, all agents at once"
SOURCE = "Yu et al. 2022, arXiv:2103.01955"


@dataclass(frozen=True)
class MAPPOConfig(AlgoConfig):
    """MAPPO is central critic x PPO x simultaneous."""

    name: str = "mappo"
    critic: Literal["central"] = "central"
    """V(s) of the global state. With V(o) it is algo=ippo; algo=custom takes any critic."""
    update: Literal["ppo"] = "ppo"
    """Proximal policy optimisation. algo=custom takes any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom takes any order."""

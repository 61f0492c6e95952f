"""HAPPO: heterogeneous-agent proximal policy optimisation.

Agents improve one after another, in an order i_1 ... i_N drawn anew at each update. With V(s) of the global
state and its advantage A, agent i_m takes PPO's steps on the clipped surrogate of

    M A,   M = product over j < m of pi_new^{i_j}(u|o) / pi_old^{i_j}(u|o)

(Kuba et al. 2022, arXiv:2109.11251, section 4.2): what the team's advantage becomes once those before it
have changed, so that each improves on what the others already do. In the exact scheme that this approximates
the joint policy never gets worse. Each agent has a policy of its own, or each group one (`policies:
groups`), whose agents have their turn together.

Neighbours: MAPPO has M = 1, all agents at once; HATRPO takes TRPO's step.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "PPO with a central critic, one agent after another, each weighed by those before it"
SOURCE = "Kuba et al. 2022, arXiv:2109.11251"


@dataclass(frozen=True)
class HAPPOConfig(AlgoConfig):
    """HAPPO is central critic x PPO x sequential."""

    name: str = "happo"
    critic: Literal["central"] = "central"
    """V(s) of the global state. algo=custom takes any critic."""
    update: Literal["ppo"] = "ppo"
    """Proximal policy optimisation. With TRPO it is algo=hatrpo; algo=custom takes any update."""
    order: Literal["sequential"] = "sequential"
    """One agent after another; all at once it is algo=mappo. algo=custom takes any order."""

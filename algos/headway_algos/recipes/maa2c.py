"""MAA2C: multi-agent advantage actor-critic with a central critic.

Policies pi_a(u|o) stay decentralised and take A2C's one gradient step up E[log pi_a(u|o) A] + c H(pi_a), as
in IA2C; the advantages come from a critic V(s) of the global state, used in training only (Papoudakis et
al. 2021, arXiv:2006.07869).

Neighbours: IA2C's critic sees only o; MAPPO goes over the same experience several times under a clip; COMA
gives each agent the advantage over its own other choices. With order: sequential it is HAA2C, which has no
name here: algo=custom algo.critic=central algo.update=a2c algo.order=sequential.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "A2C with a central critic of the global state, all agents at once"
SOURCE = "Papoudakis et al. 2021, arXiv:2006.07869"


@dataclass(frozen=True)
class MAA2CConfig(AlgoConfig):
    """MAA2C is central critic x A2C x simultaneous."""

    name: str = "maa2c"
    critic: Literal["central"] = "central"
    """V(s) of the global state. With V(o) it is algo=ia2c; algo=custom takes any critic."""
    update: Literal["a2c"] = "a2c"
    """One gradient step. algo=custom takes any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom takes any order."""
    epochs: int = 1
    """Passes of the critic; the actor takes one step whatever this is."""
    minibatches: int = 1
    """Of the critic's passes; the actor's step is over the whole batch whatever this is."""

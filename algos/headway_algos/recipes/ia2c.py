"""IA2C: independent advantage actor-critic.

Every agent a takes one gradient step up

    E[log pi_a(u|o) A] + c H(pi_a)

over the iteration's experience (Mnih et al. 2016, arXiv:1602.01783, section 4, with the workers in step),
with advantages from a critic V(o) of its own observation and an entropy bonus, as if the other agents were
part of the environment.

Neighbours: MAA2C replaces V(o) by V(s); IPPO goes over the same experience several times, which its clip
makes safe; ITRPO takes one step too, along the natural gradient.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "independent A2C: local critic, one gradient step, all agents at once"
SOURCE = "Mnih et al. 2016, arXiv:1602.01783"


@dataclass(frozen=True)
class IA2CConfig(AlgoConfig):
    """IA2C is local critic x A2C x simultaneous."""

    name: str = "ia2c"
    critic: Literal["local"] = "local"
    """V(o) of an agent's own observation. With V(s) it is algo=maa2c; algo=custom takes any critic."""
    update: Literal["a2c"] = "a2c"
    """One gradient step. algo=custom takes any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom takes any order."""
    epochs: int = 1
    """Passes of the critic; the actor takes one step whatever this is."""
    minibatches: int = 1
    """Of the critic's passes; the actor's step is over the whole batch whatever this is."""

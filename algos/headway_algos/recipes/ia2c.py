"""IA2C: independent advantage actor-critic.

Each agent a takes one gradient step on the whole batch of an iteration, in ascent of

    E[log pi_a(u|o) A] + c H(pi_a)

(Mnih et al. 2016, arXiv:1602.01783, section 4, with synchronous workers). Advantages come from a critic V(o)
of the agent's own observation; the other agents are treated as part of the environment.

Related: MAA2C replaces V(o) by V(s); IPPO makes several passes over the same batch, with a clipped surrogate;
ITRPO takes one step along the natural gradient.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "independent A2C: local critic, one gradient step, all agents at once"
SOURCE = "Mnih et al. 2016, arXiv:1602.01783"


@dataclass(frozen=True)
class IA2CConfig(AlgoConfig):
    """IA2C: local critic, A2C update, simultaneous order."""

    name: str = "ia2c"
    critic: Literal["local"] = "local"
    """V(o) of an agent's own observation. For V(s): algo=maa2c; algo=custom accepts any critic."""
    update: Literal["a2c"] = "a2c"
    """One gradient step. algo=custom accepts any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom accepts any order."""
    epochs: int = 1
    """Passes of the critic over the batch; the actor always takes one step."""
    minibatches: int = 1
    """Minibatches per pass of the critic; the actor always uses the whole batch."""

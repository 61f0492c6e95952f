"""MAA2C: multi-agent advantage actor-critic with a central critic.

Decentralised policies pi_a(u|o) take one gradient step per iteration, as in IA2C, in ascent of
E[log pi_a(u|o) A] + c H(pi_a). Advantages come from a critic V(s) of the global state, used in training only
(Papoudakis et al. 2021, arXiv:2006.07869).

Related: IA2C's critic sees only o; MAPPO makes several passes over the same batch, with a clipped surrogate;
COMA's advantages compare each agent's own actions. The sequential version, HAA2C, has no name here:
algo=custom algo.critic=central algo.update=a2c algo.order=sequential.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "A2C with a central critic of the global state, all agents at once"
SOURCE = "Papoudakis et al. 2021, arXiv:2006.07869"


@dataclass(frozen=True)
class MAA2CConfig(AlgoConfig):
    """MAA2C: central critic, A2C update, simultaneous order."""

    name: str = "maa2c"
    critic: Literal["central"] = "central"
    """V(s) of the global state. For V(o): algo=ia2c; algo=custom accepts any critic."""
    update: Literal["a2c"] = "a2c"
    """One gradient step. algo=custom accepts any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom accepts any order."""
    epochs: int = 1
    """Passes of the critic over the batch; the actor always takes one step."""
    minibatches: int = 1
    """Minibatches per pass of the critic; the actor always uses the whole batch."""

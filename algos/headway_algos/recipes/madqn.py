"""MADQN: multi-agent deep Q-learning.

Every agent a values its own actions by a network Q(o, u), takes the best or, with a chance of epsilon, any
that is allowed, and learns from a memory of all it lived through, by steps down

    E[l(Q(o, u) - y)],   y = r + gamma Q'(o', argmax_u' Q(o', u'))

where Q' is a copy of Q made now and then (Mnih et al. 2015, doi 10.1038/nature14236), and the choice by Q of
what Q' judges keeps the maximum of noisy values from being too high (van Hasselt et al. 2016,
arXiv:1509.06461; `double: false` lets Q' choose). The other agents are part of the environment, also where
they share the network (as on the merging lanes of Chen et al. 2022, arXiv:2105.05701). Where an agent does
not decide at every step, r is all it is paid until its next decision, discounted, and gamma is to the power
of the steps between.

Neighbours: DDPG is the same for actions in a Box; IPPO learns a policy, from what it has just done alone.
"""

from dataclasses import dataclass

from headway.contracts.checks import require
from headway_algos.replay_config import ReplayConfig

SUMMARY = "deep Q-learning of each agent: replay memory, target network, epsilon-greedy; Discrete actions"
SOURCE = "Mnih et al. 2015, doi 10.1038/nature14236; van Hasselt et al. 2016, arXiv:1509.06461"


@dataclass(frozen=True)
class MADQNConfig(ReplayConfig):
    """MADQN is Q-learning from a memory, with epsilon-greedy exploration."""

    name: str = "madqn"
    double: bool = True
    """The network in learning chooses the action whose value the target network gives; false: the target
    network does both."""
    exploration_start: float = 1.0
    """Epsilon, the chance of a random action, at first."""
    exploration_end: float = 0.05
    """Epsilon in the end."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.exploration_start <= 1, "exploration_start must be at most 1: it is a chance")

"""COMA: counterfactual multi-agent policy gradients.

A team's reward says little of what one agent did for it. COMA asks a central critic Q(s, u) what would
have come of every other action u' of agent a, those of the others, u^-a, being what they were, and
credits the action taken with its difference to the policy's own mean,

    A^a(s, u) = Q(s, u) - sum_u' pi_a(u'|o^a) Q(s, (u^-a, u'))

(Foerster et al. 2018, arXiv:1705.08926, equation 4). The baseline does not depend on u^a, so it leaves
the policy gradient as it is. One network gives Q of all own actions at once from (s, u^-a, o^a, id_a);
it learns TD(lambda) targets that bootstrap from a target network, copied now and then. The paper's u_t-1
among the inputs is left out; recurrence, which it has in the actor alone, is a choice for actor and critic
(`model.core`).

Neighbours: MAA2C has the same step with advantages from V(s), equal for all agents of a team; MAPPO with
`critic_actions: others` sees u^-a too, but learns from returns instead of comparing own actions.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "counterfactual central critic Q(s, u), all agents at once; Discrete actions"
SOURCE = "Foerster et al. 2018, arXiv:1705.08926"


@dataclass(frozen=True)
class COMAConfig(AlgoConfig):
    """COMA is counterfactual critic x A2C x simultaneous."""

    name: str = "coma"
    critic: Literal["counterfactual"] = "counterfactual"
    """Q(s, u) of each own action. algo=custom takes any critic."""
    update: Literal["a2c"] = "a2c"
    """One gradient step. algo=custom takes any update."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom takes any order."""
    epochs: int = 1
    """Passes of the critic; the actor takes one step whatever this is."""
    minibatches: int = 1
    """Of the critic's passes; the actor's step is over the whole batch whatever this is."""

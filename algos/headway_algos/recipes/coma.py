"""COMA: counterfactual multi-agent policy gradients.

A team reward does not show which agent earned it. COMA's central critic Q(s, u) compares the action that
agent a took with its alternatives u', the other agents' actions u^-a held fixed, and credits the difference
from the policy's expectation:

    A^a(s, u) = Q(s, u) - sum_u' pi_a(u'|o^a) Q(s, (u^-a, u'))

(Foerster et al. 2018, arXiv:1705.08926, equation 4). The baseline does not depend on u^a, so the policy
gradient is unbiased. One network with inputs (s, u^-a, o^a, id_a) has one output for each action of agent a;
it is trained on TD(lambda) targets that bootstrap from a target network, copied every `target_every`
iterations.
Differences from the paper: u_t-1 is not among the inputs, and recurrence, which the paper has in the actor
only, is an option for actor and critic together (`model.core`).

Related: MAA2C takes the same step with advantages from V(s), equal for all agents of a team; MAPPO with
`critic_actions: others` conditions on u^-a too, but regresses on returns instead of comparing own actions.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="coma",
    summary="A2C with a counterfactual central critic Q(s, u), all agents at once; Discrete actions",
    source="Foerster et al. 2018, arXiv:1705.08926",
    critic="counterfactual",
    update="a2c",
    order="simultaneous",
)

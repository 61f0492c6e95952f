"""MAA2C: multi-agent advantage actor-critic with a central critic.

Decentralised policies pi_a(u|o) take one gradient step per iteration, as in IA2C, in ascent of
E[log pi_a(u|o) A] + c H(pi_a). Advantages come from a critic V(s) of the global state, used in training only
(Papoudakis et al. 2021, arXiv:2006.07869).

Related: IA2C's critic sees only o; MAPPO makes several passes over the same batch, with a clipped surrogate;
COMA's advantages compare each agent's own actions. The sequential version, HAA2C, has no name here:
algo=custom algo.critic=central algo.update=a2c algo.order=sequential.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="maa2c",
    summary="A2C with a central critic of the global state, all agents at once",
    source="Papoudakis et al. 2021, arXiv:2006.07869",
    critic="central",
    update="a2c",
    order="simultaneous",
)

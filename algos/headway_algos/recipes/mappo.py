"""MAPPO: multi-agent proximal policy optimisation with a central critic.

Decentralised policies pi_a(u|o) are trained with PPO's clipped surrogate, as in IPPO. Advantages come from a
critic V(s) of the global state, used in training only (Yu et al. 2022, arXiv:2103.01955). With a shared team
reward there is one V(s) for the team, so all agents get the same advantage; with individual rewards each
policy has its own critic.

Related: IPPO's critic sees only o; MAA2C takes one plain gradient step; HAPPO updates the agents one after
another and weights advantages by the probability ratios of the agents updated before.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="mappo",
    summary="PPO with a central critic of the global state, all agents at once",
    source="Yu et al. 2022, arXiv:2103.01955",
    critic="central",
    update="ppo",
    order="simultaneous",
)

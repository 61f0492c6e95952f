"""IPPO: independent proximal policy optimisation.

Each agent a improves its own policy pi_a(u|o) by gradient ascent on PPO's clipped surrogate

    L(theta) = E[min(rho A, clip(rho, 1 - eps, 1 + eps) A)],   rho = pi_theta(u|o) / pi_old(u|o)

(Schulman et al. 2017, arXiv:1707.06347, equation 7), with generalised advantage estimation
(arXiv:1506.02438) from a critic V(o) of its own observation. The other agents are treated as part of the
environment (de Witt et al. 2020, arXiv:2011.09533).

Related: MAPPO replaces V(o) by V(s); IA2C takes one plain gradient step instead of PPO's epochs;
ITRPO replaces the clip by a trust region.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="ippo",
    summary="independent PPO: local critic, clipped surrogate, all agents at once",
    source="Schulman et al. 2017, arXiv:1707.06347; de Witt et al. 2020, arXiv:2011.09533",
    critic="local",
    update="ppo",
    order="simultaneous",
)

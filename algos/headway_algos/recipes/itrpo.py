"""ITRPO: independent trust-region policy optimisation.

Each agent a takes one step that solves, with a linear objective and a quadratic constraint,

    maximise E[pi_a(u|o) / pi_old(u|o) A]   subject to   E[KL(pi_old || pi_a)] <= delta

(Schulman et al. 2015, arXiv:1502.05477, equation 14), with advantages from a critic V(o) of its own
observation. The other agents are treated as part of the environment. The entropy bonus, if any, is part of
the objective.

Related: IPPO replaces the constraint by a clip and many small steps; MATRPO replaces V(o) by V(s).
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="itrpo",
    summary="independent TRPO: local critic, natural gradient in a trust region, all agents at once",
    source="Schulman et al. 2015, arXiv:1502.05477",
    critic="local",
    update="trpo",
    order="simultaneous",
)

"""MATRPO: trust-region policy optimisation with a central critic.

Decentralised policies pi_a(u|o) take TRPO's step, as in ITRPO. Advantages come from a critic V(s) of the
global state, used in training only. This is MATRPO as MARLlib defines it (Hu et al. 2023, arXiv:2210.13708).
The algorithm of Li and He (2020, arXiv:2010.07916) has the same name but differs: its agents agree on the
joint step by exchanging messages.

Related: ITRPO's critic sees only o; MAPPO replaces the trust region by a clip; HATRPO updates the agents one
after another and weights advantages by the probability ratios of the agents updated before.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="matrpo",
    summary="TRPO with a central critic of the global state, all agents at once",
    source="Schulman et al. 2015, arXiv:1502.05477, with the critic of Yu et al. 2022, arXiv:2103.01955",
    critic="central",
    update="trpo",
    order="simultaneous",
)

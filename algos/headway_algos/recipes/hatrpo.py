"""HATRPO: heterogeneous-agent trust-region policy optimisation.

Agents are updated one after another, in a random order i_1 ... i_N drawn at each update. With the advantage A
from V(s) of the global state, agent i_m takes TRPO's step on

    M A,   M = product over j < m of pi_new^{i_j}(u|o) / pi_old^{i_j}(u|o)

within a bound on its own mean KL divergence (Kuba et al. 2022, arXiv:2109.11251, section 4.1). An agent whose
line search accepts no step keeps its policy, and its ratio is 1. Each agent has its own policy, or each group
has one (`policies: groups`) and its agents are updated together.

Related: MATRPO has M = 1 and updates all agents at once; HAPPO replaces the trust region by PPO's clip.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="hatrpo",
    summary="TRPO with a central critic, one agent after another, advantages weighted by earlier ratios",
    source="Kuba et al. 2022, arXiv:2109.11251",
    critic="central",
    update="trpo",
    order="sequential",
)

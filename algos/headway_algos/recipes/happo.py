"""HAPPO: heterogeneous-agent proximal policy optimisation.

Agents are updated one after another, in a random order i_1 ... i_N drawn at each update. With the advantage A
from V(s) of the global state, agent i_m takes PPO's steps on the clipped surrogate of

    M A,   M = product over j < m of pi_new^{i_j}(u|o) / pi_old^{i_j}(u|o)

(Kuba et al. 2022, arXiv:2109.11251, section 4.2). M A estimates the advantage under the policies already
updated. In the exact scheme that this approximates, the joint policy improves monotonically. Each agent has
its own policy, or each group has one (`policies: groups`) and its agents are updated together.

Related: MAPPO has M = 1 and updates all agents at once; HATRPO takes TRPO's step.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="happo",
    summary="PPO with a central critic, one agent after another, advantages weighted by earlier ratios",
    source="Kuba et al. 2022, arXiv:2109.11251",
    critic="central",
    update="ppo",
    order="sequential",
)

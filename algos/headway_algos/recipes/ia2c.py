"""IA2C: independent advantage actor-critic.

Each agent a takes one gradient step on the whole batch of an iteration, in ascent of

    E[log pi_a(u|o) A] + c H(pi_a)

(Mnih et al. 2016, arXiv:1602.01783, section 4, with synchronous workers). Advantages come from a critic V(o)
of the agent's own observation; the other agents are treated as part of the environment.

Related: MAA2C replaces V(o) by V(s); IPPO makes several passes over the same batch, with a clipped surrogate;
ITRPO takes one step along the natural gradient.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="ia2c",
    summary="independent A2C: local critic, one gradient step, all agents at once",
    source="Mnih et al. 2016, arXiv:1602.01783",
    critic="local",
    update="a2c",
    order="simultaneous",
)

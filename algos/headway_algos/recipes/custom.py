"""A free composition: any critic with any update in any order.

Meant for combinations without a name and for ablations that change one choice. Prefer the name of a
combination that has one: runs are stored and compared by name.
"""

SUMMARY = "free composition: algo.critic x algo.update x algo.order"
SOURCE = (
    "per component: arXiv:1602.01783 (A2C), 1502.05477 (TRPO), 1707.06347 (PPO), 1708.05144 (K-FAC), "
    "2109.11251 (sequential)"
)

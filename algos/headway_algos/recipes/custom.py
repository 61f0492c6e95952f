"""A free composition: any critic with any update in any order.

Meant for combinations without a name and for ablations that change one choice. If a combination has a name,
use it: runs are stored and compared by name.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="custom",
    summary="free composition: algo.critic x algo.update x algo.order",
    source=(
        "per component: arXiv:1602.01783 (A2C), 1502.05477 (TRPO), 1707.06347 (PPO), 1708.05144 (K-FAC), "
        "2109.11251 (sequential)"
    ),
)

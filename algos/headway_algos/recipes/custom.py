"""A composition of one's own: any critic with any update in any order.

For the pieces that no named algorithm puts together, and for ablations: one choice changed, the rest as
it was. What has a name is better run by it, since runs are kept, and compared, by name.
"""

SUMMARY = "free composition: algo.critic x algo.update x algo.order"
SOURCE = (
    "of each piece: arXiv:1602.01783 (A2C), 1502.05477 (TRPO), 1707.06347 (PPO), 1708.05144 (K-FAC), "
    "2109.11251 (sequential)"
)

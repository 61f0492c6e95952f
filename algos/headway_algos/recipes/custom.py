"""A composition of one's own: any critic with any update in any order.

For the pieces that no named algorithm puts together, and for ablations: one choice changed, the rest as
it was. What has a name is better run by it, since runs are kept, and compared, by name.
"""

SUMMARY = "free composition: algo.critic x algo.update x algo.order"
SOURCE = "of each piece: Schulman et al. 2017, arXiv:1707.06347; 2015, arXiv:1506.02438"

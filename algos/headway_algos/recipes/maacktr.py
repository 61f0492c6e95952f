"""MAACKTR: multi-agent actor-critic using Kronecker-factored trust region.

One policy pi(u|o), shared by all agents, takes one step per iteration along the natural gradient of

    E[log pi(u|o) A] + c H(pi),   theta += eta d,   d = F^-1 g,   eta = min(eta_max, sqrt(2 delta / d^T F d))

(ACKTR: Wu et al. 2017, arXiv:1708.05144, section 3). F is the policy's Fisher information, approximated by
Kronecker factors (K-FAC: Martens and Grosse 2015, arXiv:1503.05671); eta_max is `lr` and delta `kl_bound`.
The critic V(o) takes natural-gradient steps on its squared error, with the Gauss-Newton matrix as F. The
shared policy is the extension of ACKTR to merging vehicles by Chen et al. (2022, arXiv:2105.05701).

Differences from these sources: actor and critic are separate networks, where Chen's share a trunk; and the
step length uses the exact Fisher information of the batch, where ACKTR uses the factors (`kfac_length`).

Related: ITRPO computes the natural gradient by conjugate gradient and adds a line search, at about ten times
as many passes over the batch; IA2C takes the plain gradient.
"""

from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="maacktr",
    summary="ACKTR with a shared policy: natural gradients for actor and critic from Kronecker factors",
    source="Wu et al. 2017, arXiv:1708.05144; Chen et al. 2022, arXiv:2105.05701",
    critic="local",
    update="kfac",
    order="simultaneous",
    defaults={"critic_update": "kfac"},
)

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

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "ACKTR with a shared policy: natural gradients for actor and critic from Kronecker factors"
SOURCE = "Wu et al. 2017, arXiv:1708.05144; Chen et al. 2022, arXiv:2105.05701"


@dataclass(frozen=True)
class MAACKTRConfig(AlgoConfig):
    """MAACKTR: local critic, K-FAC update of actor and critic, simultaneous order."""

    name: str = "maacktr"
    critic: Literal["local"] = "local"
    """V(o) of an agent's own observation. algo=custom accepts any critic."""
    update: Literal["kfac"] = "kfac"
    """Natural gradients from Kronecker factors. algo=custom accepts any update."""
    critic_update: Literal["adam", "kfac"] = "kfac"
    """`kfac`: natural gradients for the critic too, as in the paper; `adam`: plain gradient steps."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom accepts any order."""
    policies: Literal["independent", "shared", "groups"] = "shared"
    """`shared`: one policy for all agents, as in the paper; `independent`: one per agent; `groups`: one per
    group of the environment."""
    lr: float = 0.25
    """Maximum step size along the natural gradient (eta_max), for the actor and, if `critic_lr` is null, for
    the critic."""
    epochs: int = 1
    """Passes of the critic over the batch; the actor always takes one step."""
    minibatches: int = 1
    """Minibatches per pass of the critic; the actor always uses the whole batch."""

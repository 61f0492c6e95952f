"""MAACKTR: multi-agent actor-critic using Kronecker-factored trust region.

One policy pi(u|o) serves all agents and takes one step up the natural gradient of

    E[log pi(u|o) A] + c H(pi),   theta += eta d,   d = F^-1 g,   eta = min(eta_max, sqrt(2 delta / d^T F d))

(ACKTR: Wu et al. 2017, arXiv:1708.05144, section 3), where F is the Fisher information of the policy in
Kronecker factors (K-FAC: Martens and Grosse 2015, arXiv:1503.05671), eta_max is `lr` and delta `kl_bound`.
The critic V(o) takes such steps too, down its squared errors, with the Gauss-Newton matrix for F. That agents
share one policy is what Chen et al. (2022, arXiv:2105.05701) made of ACKTR for vehicles that merge.

Two things differ: actor and critic are networks of their own here, where Chen's have one trunk; and a step's
length is by the Fisher information of the batch itself, where ACKTR takes the factors again (`kfac_length`).

Neighbours: ITRPO solves for the natural gradient by conjugate gradient and searches along it, for which it
passes over the batch ten times as often; IA2C takes the plain gradient.
"""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig

SUMMARY = "ACKTR with a shared policy: natural gradients of actor and critic by Kronecker factors"
SOURCE = "Wu et al. 2017, arXiv:1708.05144; Chen et al. 2022, arXiv:2105.05701"


@dataclass(frozen=True)
class MAACKTRConfig(AlgoConfig):
    """MAACKTR is local critic x K-FAC x simultaneous, with a critic that takes K-FAC's steps too."""

    name: str = "maacktr"
    critic: Literal["local"] = "local"
    """V(o) of an agent's own observation. algo=custom takes any critic."""
    update: Literal["kfac"] = "kfac"
    """Natural gradients by Kronecker factors. algo=custom takes any update."""
    critic_update: Literal["adam", "kfac"] = "kfac"
    """As the actor's, as the source has it, or `adam`."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once. algo=custom takes any order."""
    policies: Literal["independent", "shared", "groups"] = "shared"
    """One policy for all, as the source has it; one an agent, or one for each group the environment names."""
    lr: float = 0.25
    """The most of the natural gradient that a step goes (eta_max): the actor's and, if `critic_lr` is null,
    the critic's."""
    epochs: int = 1
    """Passes of the critic; the actor takes one step whatever this is."""
    minibatches: int = 1
    """Of the critic's passes; the actor's step is over the whole batch whatever this is."""

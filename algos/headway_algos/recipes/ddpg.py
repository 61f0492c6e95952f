"""DDPG: deep deterministic policy gradient, every agent by itself.

Every agent a acts by u = mu(o), a network within the bounds of its actions, and explores by adding noise that
wanders (Ornstein-Uhlenbeck: what it adds now is close to what it added before). From a memory of all it lived
through, its critic Q(o, u) takes a step down E[l(Q(o, u) - y)] and its actor one up Q along its own action:

    y = r + gamma Q'(o', mu'(o')),   dJ/dtheta = E[dQ/du(o, u = mu(o)) dmu/dtheta(o)]

(Lillicrap et al. 2016, arXiv:1509.02971, algorithm 1), where Q' and mu' are copies that follow slowly:
theta' <- tau theta + (1 - tau) theta'. Not of the paper: actions enter the critic with the observation,
observations are normalised by their running moments instead of batches', there is no weight decay, and the
actor may be held from the bounds of its actions (`saturation_coeff`; 0, the default, is the paper's).

Neighbours: MADQN is the same for Discrete actions, which need no actor; IPPO learns a Gaussian policy, from
what it has just done alone.
"""

from dataclasses import dataclass
from typing import Literal

from headway.contracts.checks import require
from headway_algos.replay_config import ReplayConfig

SUMMARY = "deterministic actor and Q critic of each agent: replay memory, target networks; Box actions"
SOURCE = "Lillicrap et al. 2016, arXiv:1509.02971"


@dataclass(frozen=True)
class DDPGConfig(ReplayConfig):
    """DDPG is deterministic policy gradients from a memory, with Ornstein-Uhlenbeck exploration."""

    name: str = "ddpg"
    lr: float = 1e-4
    """Learning rate of the actor (Adam)."""
    critic_lr: float | None = 1e-3
    """Learning rate of the critic; null: `lr`."""
    target_every: int = 1
    """Steps of learning between updates of the target networks."""
    tau: float = 0.005
    """Share of the way that target networks go to the networks in learning at each of their updates; 1: a
    copy."""
    loss: Literal["huber", "squared"] = "squared"
    """Of the difference from a target: half its square, or (Huber) linear beyond 1."""
    saturation_coeff: float = 0.0
    """Weight, beside Q, of the squares of what the actor puts into its tanh, summed over the actions of an
    agent: without it actions stick to the bounds, where no gradient is left (Andrychowicz et al. 2017,
    arXiv:1707.01495, appendix A). It is in units of reward: of rewards ten times as large it must be ten
    times, too, to do the same."""
    ou_theta: float = 0.15
    """Share of the noise that a step takes away."""
    ou_sigma: float = 0.2
    """Standard deviation of what a step adds to the noise, where the bounds are 1 from their middle."""
    exploration_start: float = 1.0
    """Scale of the noise at first."""
    exploration_end: float = 0.1
    """Scale of the noise in the end."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.critic_lr is None or self.critic_lr > 0, "critic_lr must be above 0, or null")
        require(self.saturation_coeff >= 0, "saturation_coeff must be at least 0")
        require(0 <= self.ou_theta <= 1, "ou_theta must lie in [0, 1]")
        require(self.ou_sigma >= 0, "ou_sigma must be at least 0")

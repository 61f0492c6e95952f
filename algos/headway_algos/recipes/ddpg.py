"""DDPG: deep deterministic policy gradient, with independent agents.

Each agent acts by a deterministic network u = mu(o), scaled to the bounds of its actions, and explores with
Ornstein-Uhlenbeck noise, which is correlated in time. On minibatches from the replay buffer the critic
Q(o, u) descends E[l(Q(o, u) - y)] and the actor ascends Q at its own action:

    y = r + gamma Q'(o', mu'(o')),   dJ/dtheta = E[dQ/du(o, u = mu(o)) dmu/dtheta(o)]

(Lillicrap et al. 2016, arXiv:1509.02971, algorithm 1). Q' and mu' are target networks, theta' <- tau theta +
(1 - tau) theta'. Differences from the paper: actions enter the critic's first layer, observations are
normalised by running statistics instead of batch normalisation, there is no weight decay, and a penalty can
keep the actor off the bounds (`saturation_coeff`; 0, the default, is the paper's).

Related: MADQN is the counterpart for Discrete actions and needs no actor; IPPO learns a Gaussian policy from
on-policy data.
"""

from dataclasses import dataclass
from typing import Literal

from headway.contracts import Box, Lazy
from headway.contracts.checks import require
from headway_algos.replay_config import ReplayConfig, ReplayRecipe


@dataclass(frozen=True)
class DDPGConfig(ReplayConfig):
    """DDPG: deterministic policy gradient with a replay buffer and Ornstein-Uhlenbeck exploration."""

    name: str = "ddpg"
    lr: float = 1e-4
    """Learning rate of the actor (Adam)."""
    critic_lr: float | None = 1e-3
    """Learning rate of the critic; null: `lr`."""
    target_every: int = 1
    """Gradient steps between updates of the target networks."""
    tau: float = 0.005
    """Step size of a target network's update towards its online network; 1: copy."""
    loss: Literal["huber", "squared"] = "squared"
    """Loss of the temporal-difference error: half its square, or (Huber) linear beyond 1."""
    saturation_coeff: float = 0.0
    """Weight of a penalty in the actor's objective: the squared inputs of its tanh, summed over the
    components of an action. Without it actions can stick to the bounds, where the gradient vanishes
    (Andrychowicz et al. 2017, arXiv:1707.01495, appendix A). In units of reward: scale it with them."""
    ou_theta: float = 0.15
    """Share by which the noise decays per step."""
    ou_sigma: float = 0.2
    """Standard deviation of the noise's increment per step, in units of half the action range."""
    exploration_start: float = 1.0
    """Initial scale of the noise."""
    exploration_end: float = 0.1
    """Final scale of the noise."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.critic_lr is None or self.critic_lr > 0, "critic_lr must be above 0, or null")
        require(self.saturation_coeff >= 0, "saturation_coeff must be at least 0")
        require(0 <= self.ou_theta <= 1, "ou_theta must lie in [0, 1]")
        require(self.ou_sigma >= 0, "ou_sigma must be at least 0")


RECIPE = ReplayRecipe(
    name="ddpg",
    summary="deterministic actor and Q critic per agent: replay buffer, target networks; Box actions",
    source="Lillicrap et al. 2016, arXiv:1509.02971",
    config=DDPGConfig,
    actions=Box,
    method=Lazy("headway_algos.off_policy.ddpg:DeterministicPolicyGradient"),
)

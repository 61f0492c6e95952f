"""DDPG: deep deterministic policy gradient, with independent agents.

Each agent acts by a deterministic network u = mu(o), scaled to the bounds of its actions, and explores with
Ornstein-Uhlenbeck noise, which is correlated in time. On minibatches from the replay buffer the critic
Q(o, u) descends E[l(Q(o, u) - y)] and the actor ascends Q at its own action:

    y = r + gamma Q'(o', mu'(o')),   dJ/dtheta = E[dQ/du(o, u = mu(o)) dmu/dtheta(o)]

(Lillicrap et al. 2016, arXiv:1509.02971, algorithm 1). Q' and mu' are target networks, theta' <- tau theta +
(1 - tau) theta'. Differences from the paper: actions enter the critic's first layer, observations are
normalised by running statistics instead of batch normalisation, rewards are divided by the root mean square
of those in the replay buffer (`normalise_rewards`), there is no weight decay, and a penalty can keep the
actor off the bounds (`saturation_coeff`; 0, the default, is the paper's).

Related: MADQN is the counterpart for Discrete actions and needs no actor; IPPO learns a Gaussian policy from
on-policy data.
"""

from headway.contracts import Box, Lazy
from headway_algos.recipes import ReplayRecipe
from headway_algos.replay_config import DDPGConfig

RECIPE = ReplayRecipe(
    name="ddpg",
    summary="deterministic actor and Q critic per agent: replay buffer, target networks; Box actions",
    source="Lillicrap et al. 2016, arXiv:1509.02971",
    config=DDPGConfig,
    actions=Box,
    make_method=Lazy("headway_algos.off_policy.ddpg:DeterministicPolicyGradient"),
)

"""MADQN: multi-agent deep Q-learning.

Each agent has a network Q(o, u) over its own actions, acts epsilon-greedily among the allowed ones, and
learns from minibatches of a replay buffer by gradient descent on

    E[l(Q(o, u) - y)],   y = r + gamma Q'(o', argmax_u' Q(o', u'))

Q' is a target network, copied every `target_every` steps (Mnih et al. 2015, doi 10.1038/nature14236).
Choosing the action by Q and evaluating it by Q' reduces overestimation (van Hasselt et al. 2016,
arXiv:1509.06461); `double: false` lets Q' do both. The other agents are treated as part of the environment,
also where they share the network (as do the merging vehicles of Chen et al. 2022, arXiv:2105.05701). For
agents that do not act at every step, r is the discounted sum of rewards until the next decision, and gamma is
raised to the number of steps between.

Related: DDPG is the counterpart for Box actions; IPPO learns a policy from on-policy data.
"""

from headway.contracts import Discrete, Lazy
from headway_algos.recipes import ReplayRecipe
from headway_algos.replay_config import MADQNConfig

RECIPE = ReplayRecipe(
    name="madqn",
    summary="independent deep Q-learning: replay buffer, target network, epsilon-greedy; Discrete actions",
    source="Mnih et al. 2015, doi 10.1038/nature14236; van Hasselt et al. 2016, arXiv:1509.06461",
    config=MADQNConfig,
    actions=Discrete,
    make_method=Lazy("headway_algos.off_policy.dqn:QLearning"),
)

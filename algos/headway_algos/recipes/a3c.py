"""A3C: asynchronous advantage actor-critic.

Each of W workers collects `rollout.steps` steps with parameters theta_k and computes IA2C's gradient,

    g = grad E[log pi(u|o) A] + c grad H(pi)   at theta_k,      theta <- theta + Adam(clip(g)),

and likewise the critic's, of -E[(V(o) - R)^2]. The learner applies each gradient on arrival, to parameters
that may be newer than theta_k, and returns the result to that worker (Mnih et al. 2016, arXiv:1602.01783,
section 4). No worker waits for another, so gradients are stale by about W - 1 updates (metric
`staleness/mean`). There is one worker per block of copies: W = rollout.copies / rollout.block. While the
learner evaluates or writes a checkpoint, rollouts continue but their gradients wait; evaluation runs in one
process and adds its full duration.

Differences from the paper:
- Worker processes send gradients to one learner process, instead of threads that write to shared memory
  without locks: no update is lost or read half-written.
- Adam instead of RMSProp, with shared moments like the paper's best variant.
- Separate networks for actor and critic.
- Rollouts continue across the ends of episodes.
- Generalised advantage estimation, standardised; the paper's advantages are `gae_lambda: 1`.
- Observations and returns are normalised by running statistics over all workers.

Related: IA2C is the synchronous version, and equals A3C with one worker; IPPO makes several passes over the
same batch.
"""

from headway.contracts import Lazy
from headway_algos.on_policy.a3c_config import A3CConfig
from headway_algos.recipes import Recipe

RECIPE = Recipe(
    name="a3c",
    summary="asynchronous A2C: workers compute gradients on their own rollouts, applied on arrival",
    source="Mnih et al. 2016, arXiv:1602.01783",
    critic="local",
    update="a2c",
    order="simultaneous",
    critic_update="adam",
    # Each rollout gives one gradient; a shared policy cannot be split; training cannot start from a rule.
    fixed={
        "epochs": 1,
        "minibatches": 1,
        "shared_until": 0.0,
        "apart_lr": 1.0,
        "imitation_entropy_coeff": 0.3,
    },
    config=A3CConfig,
    # Four workers of two copies each, which send a gradient every 64 environment steps.
    rollout={"copies": 8, "steps": 32, "block": 2},
    learner=Lazy("headway_algos.on_policy.a3c_learner:AsynchronousA2CLearner"),
    contributor=Lazy("headway_algos.on_policy.a3c_learner:A2CContributor"),
    preload=("headway_algos.on_policy.a3c_learner",),
)

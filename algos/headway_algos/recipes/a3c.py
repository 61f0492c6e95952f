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

from dataclasses import dataclass
from typing import Literal

from headway.contracts.checks import require
from headway_algos.config import AlgoConfig

SUMMARY = "asynchronous A2C: workers compute gradients on their own rollouts, applied on arrival"
SOURCE = "Mnih et al. 2016, arXiv:1602.01783"


@dataclass(frozen=True)
class A3CConfig(AlgoConfig):
    """A3C: local critic, A2C update, simultaneous order, in asynchronous workers."""

    name: str = "a3c"
    critic: Literal["local"] = "local"
    """V(o) of an agent's own observation. algo=custom accepts any critic, in synchronous training."""
    update: Literal["a2c"] = "a2c"
    """One gradient step per rollout of a worker. algo=custom accepts any update, in synchronous training."""
    critic_update: Literal["adam"] = "adam"
    """Adam, on critic gradients that the workers compute."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents are updated at once."""
    application: Literal["arrival", "in_turns"] = "arrival"
    """When a worker's gradient is applied. `arrival`: as soon as it arrives, so that runs are not
    reproducible; `in_turns`: in a fixed order of workers, which is reproducible but makes fast workers wait
    (for tests). backend=serial always works in turns."""
    epochs: int = 1
    """Always 1: one gradient per rollout."""
    minibatches: int = 1
    """Always 1: each gradient is of the whole rollout."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.epochs == 1, "epochs must be 1 for a3c: each rollout gives one gradient")
        require(self.minibatches == 1, "minibatches must be 1 for a3c: each gradient is of a whole rollout")
        require(self.shared_until == 0, "shared_until must be 0 for a3c, which cannot split a shared policy")

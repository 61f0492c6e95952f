"""A3C: asynchronous advantage actor-critic.

W workers each roll out `rollout.steps` steps and find the gradient that IA2C would take its step along,

    g = grad E[log pi(u|o) A] + c grad H(pi)   at theta_k,      theta <- theta + Adam(clip(g)),

and the critic's, down E[(V(o) - R)^2], alike. They come to the learner when they are done: it applies each at
once, to parameters that others may have changed since theta_k, and gives the worker those that it led to
(Mnih et al. 2016, arXiv:1602.01783, section 4). No worker waits for another; gradients are stale by about
W - 1 updates (`staleness/mean` of a curve). There is a worker for each block of copies:
W = rollout.copies / rollout.block. All wait for the learner where it is busy: rollouts under way go on while
it evaluates or writes a checkpoint, but what they give is applied only after that, so that evaluation, which
one process does, costs as much time as it takes there.

What differs from the source: workers are processes that send gradients to one that applies them, instead of
threads that write to shared memory without locks, so no update is read half done or lost. Steps are Adam's,
not RMSProp's; its moments are shared, as the source's best are. Actor and critic are networks of their own.
Rollouts go on where an episode ends. Advantages are generalised ones (the source's are `gae_lambda: 1`), and
standardised. Observations and returns are normalised by moments of what all workers saw.

Neighbours: IA2C is the same with workers in step, and what one worker alone does; IPPO goes over the same
experience several times instead.
"""

from dataclasses import dataclass
from typing import Literal

from headway.contracts.checks import require
from headway_algos.config import AlgoConfig

SUMMARY = "asynchronous A2C: workers find gradients on their own rollouts, applied as they come"
SOURCE = "Mnih et al. 2016, arXiv:1602.01783"


@dataclass(frozen=True)
class A3CConfig(AlgoConfig):
    """A3C is local critic x A2C x simultaneous, in workers that do not wait for one another."""

    name: str = "a3c"
    critic: Literal["local"] = "local"
    """V(o) of an agent's own observation. algo=custom takes any critic, in step."""
    update: Literal["a2c"] = "a2c"
    """One gradient step for each rollout of a worker. algo=custom takes any update, in step."""
    critic_update: Literal["adam"] = "adam"
    """The critic's gradients are workers', too."""
    order: Literal["simultaneous"] = "simultaneous"
    """All agents at once."""
    application: Literal["arrival", "in_turns"] = "arrival"
    """When a worker's gradient is applied: `arrival`: when it comes, so that no two runs are the same;
    `in_turns`: one worker after another, always in the same order, so that they are (for tests: fast workers
    wait for slow ones). backend=serial always takes turns."""
    epochs: int = 1
    """Always 1: a rollout gives one gradient."""
    minibatches: int = 1
    """Always 1: of the whole rollout."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.epochs == 1, "epochs must be 1 for a3c: a worker's rollout gives one gradient")
        require(self.minibatches == 1, "minibatches must be 1 for a3c: a gradient is of a whole rollout")
        require(self.shared_until == 0, "shared_until must be 0 for a3c, whose policies do not part")

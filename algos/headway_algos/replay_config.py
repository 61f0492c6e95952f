"""What the algorithms that learn from a replay memory have in common, as one frozen record."""

from dataclasses import dataclass, field
from math import exp
from typing import Literal

from headway.contracts.checks import require


@dataclass(frozen=True)
class NetworkConfig:
    """Multilayer perceptrons. Histories are shown by the wrapper frame_stack_v1: a memory of single
    transitions has none."""

    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers."""
    activation: Literal["tanh", "relu"] = "relu"
    """Between the layers."""

    def __post_init__(self) -> None:
        require(all(size >= 1 for size in self.hidden), "hidden sizes must be at least 1")


@dataclass(frozen=True)
class ReplayConfig:
    """An algorithm that keeps its transitions and learns from each many times."""

    name: str = ""
    """Name in the registry: see `headway list algos`."""
    policies: Literal["independent", "shared", "groups"] = "independent"
    """One policy an agent, one for all, or one for each group the environment names. Each has a memory of its
    own, filled by its agents alone."""
    model: NetworkConfig = field(default_factory=NetworkConfig)
    gamma: float = 0.99
    """Discount factor a step."""
    n_step: int = 1
    """Decisions of an agent that a target looks ahead before it bootstraps. Above 1 learning is faster where
    rewards come late, and biased by what exploration did in between."""
    lr: float = 5e-4
    """Learning rate (Adam)."""
    lr_end: float = 1.0
    """Share of the learning rates left at the end of training (linear); 1: constant."""
    capacity: int = 50_000
    """Transitions that each policy's memory holds; the oldest make room."""
    learning_starts: int = 500
    """Transitions in a policy's memory from which on it learns."""
    batch_size: int = 128
    """Transitions that each policy draws for a step, uniformly and with replacement."""
    updates: int = 128
    """Steps of learning after each iteration, of rollout.copies x rollout.steps environment steps. More learn
    more from the same experience and take longer; so do shorter iterations (rollout=replay)."""
    target_every: int = 200
    """Steps of learning between updates of the target networks."""
    tau: float = 1.0
    """Share of the way that target networks go to the networks in learning at each of their updates; 1: a
    copy."""
    loss: Literal["huber", "squared"] = "huber"
    """Of the difference from a target: half its square, or (Huber) linear beyond 1."""
    grad_clip: float | None = 10.0
    """Bound of the gradient's norm, for each network; null: none."""
    exploration_start: float = 1.0
    """How much is explored at first."""
    exploration_end: float = 0.05
    """How much is explored in the end."""
    exploration_share: float = 0.5
    """Share of training in which exploration falls, linearly, from start to end; 0: at once."""
    exploration_decay_steps: float | None = None
    """Environment steps in which what exploration has above its end falls to 1/e (exponential), whatever
    `exploration_share`; null: it falls linearly."""
    normalise_observations: bool = True
    """Running mean and standard deviation per policy, part of the parameters. Memories keep observations as
    they were."""
    precision: Literal["float32", "float64"] = "float32"
    """Of networks and of what they learn from; normalisers are float64, remembered observations float32."""

    def __post_init__(self) -> None:
        require(0 <= self.gamma <= 1, "gamma must lie in [0, 1]")
        require(self.n_step >= 1, "n_step must be at least 1")
        require(self.lr > 0, "lr must be above 0")
        require(0 <= self.lr_end <= 1, "lr_end must lie in [0, 1]")
        require(self.capacity >= 1, "capacity must be at least 1")
        require(
            1 <= self.learning_starts <= self.capacity,
            f"learning_starts must be at least 1 and at most capacity ({self.capacity})",
        )
        require(self.batch_size >= 1, "batch_size must be at least 1")
        require(self.updates >= 1, "updates must be at least 1")
        require(self.target_every >= 1, "target_every must be at least 1")
        require(0 < self.tau <= 1, "tau must lie in (0, 1]")
        require(self.grad_clip is None or self.grad_clip > 0, "grad_clip must be above 0, or null")
        require(self.exploration_start >= 0, "exploration_start must be at least 0")
        require(
            0 <= self.exploration_end <= self.exploration_start,
            f"exploration_end must be at least 0 and at most exploration_start ({self.exploration_start})",
        )
        require(0 <= self.exploration_share <= 1, "exploration_share must lie in [0, 1]")
        decay = self.exploration_decay_steps
        require(decay is None or decay > 0, "exploration_decay_steps must be above 0, or null")

    def exploration(self, progress: float, env_steps: int) -> float:
        """How much is explored when a `progress` (share) of training and `env_steps` of a seed are done."""
        above = self.exploration_start - self.exploration_end
        if self.exploration_decay_steps is not None:
            return self.exploration_end + above * exp(-env_steps / self.exploration_decay_steps)
        if progress >= self.exploration_share:
            return self.exploration_end
        return self.exploration_start - above * progress / self.exploration_share

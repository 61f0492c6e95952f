"""Configuration of the off-policy algorithms, which learn from a replay buffer. Imports no torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp
from typing import ClassVar, Literal

from headway.contracts.checks import require, require_key, require_value
from headway_algos.config import LearnerConfig


@dataclass(frozen=True)
class NetworkConfig:
    """Architecture of multilayer perceptrons.

    Transitions are stored singly, without history: use the wrapper frame_stack_v1 to show past observations.
    """

    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers."""
    activation: Literal["tanh", "relu"] = "relu"
    """Activation function of the hidden layers."""

    def __post_init__(self) -> None:
        require_key(all(size >= 1 for size in self.hidden), "hidden", "must hold sizes of at least 1")


@dataclass(frozen=True)
class ReplayConfig(LearnerConfig):
    """An off-policy algorithm: networks, targets, replay buffer and exploration schedule."""

    policies: Literal["independent", "shared", "groups"] = "groups"
    """`groups`: one policy per group of alike agents, which the environment names; without groups, one for
    all. `shared`: one for all agents; `independent`: one per agent. Each policy has its own replay buffer,
    filled by its agents only."""
    model: NetworkConfig = field(default_factory=NetworkConfig)
    n_step: int = 1
    """Decisions of an agent between a transition's start and the value that its target bootstraps from. Above
    1, learning is faster with late rewards, but biased by the exploratory actions in between."""
    capacity: int = 50_000
    """Transitions per replay buffer; the oldest are overwritten."""
    learning_starts: int = 500
    """Transitions that a policy's replay buffer must hold before it is trained."""
    batch_size: int = 128
    """Transitions per policy and gradient step, drawn uniformly with replacement."""
    updates: int = 128
    """Gradient steps after each iteration of rollout.copies x rollout.steps environment steps. More steps, or
    shorter iterations, learn more from the same experience and take longer."""
    target_every: int = 200
    """Gradient steps between updates of the target networks."""
    tau: float = 1.0
    """Step size of a target network's update towards its online network; 1: copy."""
    loss: Literal["huber", "squared"] = "huber"
    """Loss of the temporal-difference error: half its square, or (Huber) linear beyond 1."""
    grad_clip: float | None = 10.0
    """Bound on the gradient norm per network; null: none."""
    exploration_start: float = 1.0
    """Initial exploration."""
    exploration_end: float = 0.05
    """Final exploration."""
    exploration_share: float = 0.5
    """Share of training over which exploration falls linearly from start to end; 0: at once."""
    exploration_decay_steps: float | None = None
    """Time constant of an exponential decay of exploration to its end, in environment steps, instead of
    `exploration_share`. null: linear decay."""
    normalise_observations: bool = True
    """Normalise observations by running statistics per policy, stored with the parameters. Replay buffers
    hold unnormalised observations."""
    normalise_rewards: bool = True
    """Divide rewards by the root mean square of the returns over `n_step` decisions in the policy's replay
    buffer, so that losses and gradients do not depend on the unit of reward."""
    VALUES_BEFORE: ClassVar[Mapping[str, object]] = {
        **LearnerConfig.VALUES_BEFORE,
        "normalise_rewards": False,
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "n_step", self.n_step >= 1, "must be at least 1")
        require_value(self, "capacity", self.capacity >= 1, "must be at least 1")
        require_value(
            self,
            "learning_starts",
            1 <= self.learning_starts <= self.capacity,
            f"must be at least 1 and at most capacity ({self.capacity})",
        )
        require_value(self, "batch_size", self.batch_size >= 1, "must be at least 1")
        require_value(self, "updates", self.updates >= 1, "must be at least 1")
        require_value(self, "target_every", self.target_every >= 1, "must be at least 1")
        require_value(self, "tau", 0 < self.tau <= 1, "must lie in (0, 1]")
        require_value(
            self, "grad_clip", self.grad_clip is None or self.grad_clip > 0, "must be above 0, or null"
        )
        require_value(self, "exploration_start", self.exploration_start >= 0, "must be at least 0")
        require_value(
            self,
            "exploration_end",
            0 <= self.exploration_end <= self.exploration_start,
            f"must be at least 0 and at most exploration_start ({self.exploration_start})",
        )
        require_value(self, "exploration_share", 0 <= self.exploration_share <= 1, "must lie in [0, 1]")
        decay = self.exploration_decay_steps
        require_value(self, "exploration_decay_steps", decay is None or decay > 0, "must be above 0, or null")
        require(
            decay is None or self.exploration_share == type(self).exploration_share,
            "set exploration_share or exploration_decay_steps, not both: each determines the decay",
        )

    def exploration(self, progress: float, env_steps: int) -> float:
        """Return the scheduled exploration after `env_steps` environment steps per seed.

        `progress` is the share of training done by then.
        """
        above = self.exploration_start - self.exploration_end
        if self.exploration_decay_steps is not None:
            return self.exploration_end + above * exp(-env_steps / self.exploration_decay_steps)
        if progress >= self.exploration_share:
            return self.exploration_end
        return self.exploration_start - above * progress / self.exploration_share


@dataclass(frozen=True)
class MADQNConfig(ReplayConfig):
    """MADQN: Q-learning with a replay buffer and epsilon-greedy exploration."""

    name: str = "madqn"
    double: bool = True
    """Double Q-learning: the online network chooses the action that the target network evaluates; false: the
    target network does both."""
    exploration_start: float = 1.0
    """Initial epsilon, the probability of a random action."""
    exploration_end: float = 0.05
    """Final epsilon."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(
            self, "exploration_start", self.exploration_start <= 1, "must be a probability, at most 1"
        )


@dataclass(frozen=True)
class DDPGConfig(ReplayConfig):
    """DDPG: deterministic policy gradient with a replay buffer and Ornstein-Uhlenbeck exploration."""

    name: str = "ddpg"
    lr: float = 1e-4
    """Learning rate of the actor (Adam)."""
    critic_lr: float | None = 1e-3
    """Learning rate of the critic; null: `lr`."""
    target_every: int = 1
    tau: float = 0.005
    loss: Literal["huber", "squared"] = "squared"
    saturation_coeff: float = 0.0
    """Weight of a penalty in the actor's objective: the squared inputs of its tanh, summed over the
    components of an action. Without it actions can stick to the bounds, where the gradient vanishes
    (Andrychowicz et al. 2017, arXiv:1707.01495, appendix A). The weight is in units of the
    rewards, after normalisation if `normalise_rewards` is set."""
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
        require_value(
            self, "critic_lr", self.critic_lr is None or self.critic_lr > 0, "must be above 0, or null"
        )
        require_value(self, "saturation_coeff", self.saturation_coeff >= 0, "must be at least 0")
        require_value(self, "ou_theta", 0 <= self.ou_theta <= 1, "must lie in [0, 1]")
        require_value(self, "ou_sigma", self.ou_sigma >= 0, "must be at least 0")

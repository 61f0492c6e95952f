"""Hyper-parameters of updates by gradient steps, and of all updates. Importing them imports no torch."""

from dataclasses import dataclass

from headway.contracts.checks import require_default, require_value
from headway_algos.config import AlgoConfig, require_for_critic
from headway_algos.optim.config import AdamConfig


@dataclass(frozen=True)
class EntropyConfig(AlgoConfig):
    """An update whose objective includes the policy's entropy."""

    entropy_coeff: float = 0.01
    """Weight of the policy's entropy in the objective (for TRPO: in the surrogate); 0: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "entropy_coeff", self.entropy_coeff >= 0, "must be at least 0")


@dataclass(frozen=True)
class GradientUpdateConfig(EntropyConfig, AdamConfig):
    """Gradient steps of Adam on a policy loss: what `GradientUpdate` reads."""


@dataclass(frozen=True)
class SingleStepConfig(EntropyConfig):
    """One step of policies per iteration, and usually of the critic: A2C's and K-FAC's."""

    epochs: int = 1
    """Passes of the critic over an iteration's batch; the actor takes one step on the whole batch."""
    minibatches: int = 1
    """Minibatches per pass of the critic; 1: the whole batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_for_critic(self, "epochs", "minibatches")


@dataclass(frozen=True)
class A2CConfig(SingleStepConfig, GradientUpdateConfig):
    """Advantage actor-critic."""


@dataclass(frozen=True)
class MinibatchConfig(GradientUpdateConfig):
    """Epochs of minibatch gradient steps, such as PPO's."""

    epochs: int = 5
    """Passes over an iteration's batch, by actor and critic."""
    minibatches: int = 8
    """Minibatches per pass, of actor and critic; 1: the whole batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "epochs", self.epochs >= 1, "must be at least 1")
        require_value(self, "minibatches", self.minibatches >= 1, "must be at least 1")


@dataclass(frozen=True)
class PPOConfig(MinibatchConfig):
    """Proximal policy optimisation."""

    clip: float = 0.2
    """PPO's clip range of the probability ratio."""
    kl_coeff: float = 0.0
    """Initial coefficient of PPO's adaptive KL penalty; 0: none."""
    kl_target: float = 0.01
    """Target KL divergence of PPO's adaptive penalty (`kl_coeff`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "clip", self.clip > 0, "must be above 0")
        require_value(self, "kl_coeff", self.kl_coeff >= 0, "must be at least 0")
        require_value(self, "kl_target", self.kl_target > 0, "must be above 0")
        problem = "applies to the penalty: set kl_coeff too, or leave kl_target out"
        require_default(self, "kl_target", self.kl_coeff > 0, problem)

"""Hyper-parameters of critics and of their training. Importing them imports no torch."""

from dataclasses import dataclass
from typing import Literal

from headway.contracts.checks import require_value
from headway_algos.config import AlgoConfig
from headway_algos.optim.config import ETA_MAX, AdamConfig, KroneckerConfig


@dataclass(frozen=True)
class CriticConfig(AlgoConfig):
    """A critic trained by regression on returns."""

    critic_update: str = "adam"
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    critic_lr: float | None = None
    """Learning rate of the critic; null: `lr`."""
    epochs: int = 5
    """Passes of the critic over an iteration's batch; the actor takes one step on the whole batch."""
    minibatches: int = 8
    """Minibatches per pass of the critic; 1: the whole batch."""
    value_clip: float | None = None
    """Bound on the critic's squared error, like RLlib's vf_clip_param, in units of squared return; with
    `normalise_values`, in units of the returns' variance. null: none."""
    normalise_values: bool = True
    """Normalise returns by running statistics before the critic is trained on them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "gae_lambda", 0 <= self.gae_lambda <= 1, "must lie in [0, 1]")
        require_value(
            self, "critic_lr", self.critic_lr is None or self.critic_lr > 0, "must be above 0, or null"
        )
        require_value(self, "epochs", self.epochs >= 1, "must be at least 1")
        require_value(self, "minibatches", self.minibatches >= 1, "must be at least 1")
        require_value(
            self, "value_clip", self.value_clip is None or self.value_clip > 0, "must be above 0, or null"
        )


@dataclass(frozen=True)
class CentralConfig(CriticConfig):
    """V(s) of the global state."""

    critic_actions: Literal["none", "others"] = "none"
    """`others`: the critic also sees the actions of the other agents, V(s, u^-a)."""


@dataclass(frozen=True)
class CounterfactualConfig(CriticConfig):
    """Q(s, u), with one value for each action that the agent could take."""

    gae_lambda: float = CriticConfig.gae_lambda
    """Lambda of the TD(lambda) targets; the counterfactual advantages have none."""
    target_every: int = 4
    """Iterations between updates of the critic's target network; 1: after every iteration."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "target_every", self.target_every >= 1, "must be at least 1")


@dataclass(frozen=True)
class AdamCriticConfig(AdamConfig):
    """Minibatch steps of Adam."""


@dataclass(frozen=True)
class KFACCriticConfig(KroneckerConfig):
    """Natural gradients with Kronecker factors of the Gauss-Newton matrix."""

    critic_lr: float | None = ETA_MAX
    """Maximum step size of the critic along the natural gradient (eta_max); null: `lr`."""
    critic_kl_bound: float = 0.3
    """K-FAC's bound for a step of the critic, on half the mean squared change of its values (the KL
    divergence of Gaussians with standard deviation 1). In normalised units with `normalise_values`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "critic_kl_bound", self.critic_kl_bound > 0, "must be above 0")

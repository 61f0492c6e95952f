"""Hyper-parameters of updates by natural gradients. Importing them imports no torch."""

from dataclasses import dataclass

from headway.contracts.checks import require, require_value
from headway_algos.config import AlgoConfig, require_for_critic
from headway_algos.on_policy.updates.config import EntropyConfig, SingleStepConfig
from headway_algos.optim.config import ETA_MAX, KroneckerConfig


@dataclass(frozen=True)
class TRPOConfig(EntropyConfig):
    """Trust-region policy optimisation."""

    lr: float = AlgoConfig.lr
    """Learning rate of the critic, unless `critic_lr` is set; the steps of policies follow `kl_bound`."""
    kl_bound: float = 0.01
    """Bound on the mean KL divergence of a step (delta)."""
    accept_ratio: float = 0.1
    """Minimum ratio of actual to expected (first-order) improvement for TRPO to accept a step."""
    cg_iterations: int = 10
    """TRPO's iterations of conjugate gradient."""
    cg_damping: float = 0.1
    """Damping added to the diagonal of TRPO's Fisher information."""
    line_search_steps: int = 10
    """Maximum number of halvings in TRPO's line search; if none is accepted, the policy stays unchanged."""
    fisher_share: float = 1.0
    """Share of the rows, evenly strided, on which TRPO's Fisher information is computed (1, 1/2, 1/3 ...;
    other values are rounded to one of these). Smaller is faster, but learns worse with only a few
    hundred rows."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "kl_bound", self.kl_bound > 0, "must be above 0")
        require_value(self, "accept_ratio", 0 <= self.accept_ratio < 1, "must lie in [0, 1)")
        require_value(self, "cg_iterations", self.cg_iterations >= 1, "must be at least 1")
        require_value(self, "cg_damping", self.cg_damping > 0, "must be above 0")
        require_value(self, "line_search_steps", self.line_search_steps >= 0, "must be at least 0")
        require_value(self, "fisher_share", 0 < self.fisher_share <= 1, "must lie in (0, 1]")
        require_for_critic(self, "lr")
        require(
            getattr(self, "critic_lr", None) is None or self.lr == type(self).lr,
            "lr or critic_lr, not both: with trpo either is the critic's learning rate",
        )


@dataclass(frozen=True)
class KFACConfig(SingleStepConfig, KroneckerConfig):
    """ACKTR's natural-gradient step."""

    lr: float = ETA_MAX
    """Maximum step size along the natural gradient (eta_max), reduced further by `kl_bound`."""
    critic_lr: float | None = AlgoConfig.lr
    """Learning rate of the critic; null: `lr`, which is too large for Adam's steps."""
    kl_bound: float = 0.01
    """Bound on the predicted mean KL divergence of a step (delta)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_for_critic(self, "critic_lr")
        require_value(self, "kl_bound", self.kl_bound > 0, "must be above 0")

"""Hyper-parameters of optimisers."""

from dataclasses import dataclass
from typing import Literal

from headway.contracts.checks import require_key, require_value
from headway_algos.config import AlgoConfig


@dataclass(frozen=True)
class AdamConfig(AlgoConfig):
    """Steps of Adam, of an actor, a critic or both."""

    grad_clip: float | None = 0.5
    """Bound on the gradient norm per network, where Adam takes the steps; null: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(
            self, "grad_clip", self.grad_clip is None or self.grad_clip > 0, "must be above 0, or null"
        )


ETA_MAX = 0.25
"""Usual maximum step size along a natural gradient, reduced further by a KL bound (Wu et al. 2017)."""


@dataclass(frozen=True)
class KroneckerConfig(AlgoConfig):
    """Natural gradients with Kronecker factors, of an actor, a critic or both."""

    kfac_damping: float = 0.01
    """Damping of K-FAC's Fisher information (lambda), split over its factors."""
    kfac_decay: float = 0.95
    """Decay of K-FAC's running averages per batch; the first batches are weighted equally."""
    kfac_every: int = 1
    """Batches between inversions of K-FAC's factors; 1: after every batch."""
    kfac_length: Literal["exact", "factors"] = "exact"
    """Fisher information from which K-FAC predicts the KL divergence of a step. `exact`: of the batch;
    `factors`: the Kronecker approximation, as published, which can predict too little."""
    kfac_momentum: float = 0.0
    """Momentum of K-FAC's direction; 0: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "kfac_damping", self.kfac_damping > 0, "must be above 0")
        require_value(self, "kfac_decay", 0 <= self.kfac_decay < 1, "must lie in [0, 1)")
        require_value(self, "kfac_every", self.kfac_every >= 1, "must be at least 1")
        require_value(self, "kfac_momentum", 0 <= self.kfac_momentum < 1, "must lie in [0, 1)")
        require_key(
            self.model.core == "none",
            "model.core",
            "must be none with kfac, whose factors exist for multilayer perceptrons only",
        )

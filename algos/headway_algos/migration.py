"""Hyper-parameters that earlier versions stored, when all on-policy algorithms had all keys."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

OBSOLETE_KEYS: Mapping[str, Any] = MappingProxyType(
    {
        "critic_actions": "none", "target_every": 4, "shared_until": 0.0, "apart_lr": 1.0,
        "clip": 0.2, "kl_coeff": 0.0, "kl_target": 0.01, "kl_bound": 0.01, "grad_clip": 0.5,
        "accept_ratio": 0.1, "cg_iterations": 10, "cg_damping": 0.1, "line_search_steps": 10,
        "fisher_share": 1.0, "kfac_damping": 0.01, "kfac_decay": 0.95, "kfac_every": 1,
        "kfac_length": "exact", "kfac_momentum": 0.0, "critic_kl_bound": 0.3,
    }
)  # fmt: skip
"""Keys that all on-policy algorithms had in earlier versions and only some have now, with their defaults
then."""

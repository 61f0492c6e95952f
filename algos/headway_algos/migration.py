"""Migration of hyper-parameters that earlier versions stored, when all on-policy algorithms had all keys."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.updates.config import PPOConfig

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


def without_effect(kept: Mapping[str, Any], record: type[AlgoConfig]) -> dict[str, Any]:
    """Return the record's defaults for those stored values that had no effect and are now rejected."""
    model = kept.get("model") or {}
    changed: dict[str, Any] = {}
    if "kl_target" in kept and not kept.get("kl_coeff"):
        changed["kl_target"] = PPOConfig.kl_target
    if kept.get("update") == "trpo" and kept.get("critic_lr") is not None:
        changed["lr"] = record.lr
    if "gru_size" in model and model.get("core") == "none":
        changed["model"] = {**model, "gru_size": ModelConfig.gru_size}
        changed["model"]["sequence_length"] = ModelConfig.sequence_length
    return changed

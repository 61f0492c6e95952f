"""The acting policy of an on-policy algorithm."""

from headway.contracts import ActingPolicy, EnvSpec
from headway_algos.acting.gru import GRUActingPolicy
from headway_algos.acting.mlp import MLPActingPolicy
from headway_algos.config import AlgoConfig


def acting_policy(config: AlgoConfig, spec: EnvSpec) -> ActingPolicy:
    """Return the acting policy of an on-policy algorithm, with or without recurrence."""
    flat = MLPActingPolicy.of(config, spec)
    return flat if config.model.core == "none" else GRUActingPolicy(flat, config.model.gru_size)

"""The acting policy of an on-policy algorithm."""

from headway.contracts import ActingPolicy, EnvSpec
from headway_algos.acting.gru import GRUActingPolicy
from headway_algos.acting.mlp import MLPActingPolicy
from headway_algos.config import AlgoConfig


def acting_policy(config: AlgoConfig, spec: EnvSpec) -> ActingPolicy:
    """Return the acting policy of an on-policy algorithm, with or without recurrence."""
    perceptron = MLPActingPolicy.of(config, spec)
    return perceptron if config.model.core == "none" else GRUActingPolicy(perceptron, config.model.gru_size)

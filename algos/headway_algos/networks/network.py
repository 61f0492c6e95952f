"""The networks of policies and critics, as configured: feedforward or recurrent."""

from collections.abc import Sequence

import torch

from headway_algos.config import ModelConfig
from headway_algos.networks.gru import RecurrentNetwork
from headway_algos.networks.mlp import StackedMLP

Network = StackedMLP | RecurrentNetwork


def make_network(
    model: ModelConfig,
    seeds: Sequence[int],
    networks_per_seed: int,
    purpose: str,
    sizes: tuple[int, int],
    last_gain: float,
    dtype: torch.dtype,
) -> Network:
    """Return stacked networks as configured, for `sizes` (inputs, outputs)."""
    full = (sizes[0], model.hidden, sizes[1])
    if model.core == "none":
        return StackedMLP(seeds, networks_per_seed, purpose, full, model.activation, last_gain, dtype)
    return RecurrentNetwork(
        seeds, networks_per_seed, purpose, full, model.activation, last_gain, dtype, model.gru_size
    )

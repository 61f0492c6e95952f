"""The networks of policies and critics, as configured: feedforward or recurrent."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway_algos.config import ModelConfig
from headway_algos.networks.gru import RecurrentNetwork
from headway_algos.networks.mlp import StackedMLP
from headway_algos.networks.normalisation import RunningStatistics

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


def acting_arrays(
    network: Network, moments: RunningStatistics, others: Mapping[str, Tensor]
) -> dict[str, NDArray[Any]]:
    """Return the arrays that an acting policy reads, by its names: observation normaliser, layers, `others`.

    They are in C order: OpenBLAS rounds the product of a transposed matrix differently.
    """
    dtype = network.weights[0].dtype
    tensors = {
        "observation_mean": moments.mean.to(dtype),
        "observation_scale": moments.scale.to(dtype),
        **others,
    }
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"weight_{i}"], tensors[f"bias_{i}"] = weight, bias
    return {name: np.ascontiguousarray(tensor.detach().cpu().numpy()) for name, tensor in tensors.items()}

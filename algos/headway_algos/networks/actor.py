"""The stacked policies in torch."""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any, Self

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway.contracts import Box, Discrete, EnvSpec, MultiDiscrete
from headway_algos.acting.mlp import actor_outputs
from headway_algos.config import ModelConfig
from headway_algos.networks.distributions import (
    CategoricalProduct,
    DiagonalGaussian,
    Distribution,
    MaskedCategorical,
)
from headway_algos.networks.gru import RecurrentNetwork
from headway_algos.networks.network import acting_arrays, make_network
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.networks.timeline import Timeline


class Actor(nn.Module):
    """P policies: observation normaliser, network, action distribution."""

    def __init__(
        self, model: ModelConfig, spec: EnvSpec, seeds: Sequence[int], policies: int, dtype: torch.dtype
    ) -> None:
        super().__init__()
        outputs = actor_outputs(spec)
        sizes = (spec.observation_size, outputs)
        self.network = make_network(model, seeds, policies, "actor", sizes, model.actor_gain, dtype)
        if model.initial_logits and isinstance(spec.action_space, Discrete):
            logits = torch.tensor(model.initial_logits, dtype=dtype)[None, :, None]
            self.network.biases[-1].data += logits
        self.moments = RunningStatistics(len(seeds) * policies, spec.observation_size)
        self.nvec = spec.action_space.nvec if isinstance(spec.action_space, MultiDiscrete) else ()
        """Options of each choice of MultiDiscrete actions; empty for others."""
        self.log_std: nn.Parameter | None = None
        if isinstance(spec.action_space, Box):
            shape = (len(seeds) * policies, outputs, 1)
            self.log_std = nn.Parameter(torch.full(shape, model.log_std, dtype=dtype))

    def forward(self, rows: Tensor, masks: Tensor | None, timeline: Timeline | None = None) -> Distribution:
        """Return action distributions for normalised observations (P, B, D) and action masks (P, B, A)."""
        return self.distribution(self.network(rows, timeline), masks)

    def distribution(
        self, outputs: Tensor, masks: Tensor | None, log_std: Tensor | None = None
    ) -> Distribution:
        """Return the action distributions of network outputs (P, A, B) under action masks (P, B, A).

        `log_std` replaces the current log standard deviation of Box actions.
        """
        if self.nvec:
            return CategoricalProduct.of_logits(outputs, masks, self.nvec)
        if self.log_std is None:
            return MaskedCategorical.of_logits(outputs, masks)
        return DiagonalGaussian(outputs, self.log_std if log_std is None else log_std)

    @property
    def learnable(self) -> list[nn.Parameter]:
        """Parameters that updates change: the log standard deviation, if any, then the network's tensors."""
        return [*([] if self.log_std is None else [self.log_std]), *self.network.parameters()]

    def narrow(self, policies: Tensor) -> Self:
        """Return a copy that holds only `policies` (n,) of the stack."""
        tensors: dict[int, Any] = {id(p): nn.Parameter(p.detach()[policies]) for p in self.parameters()}
        tensors |= {id(buffer): buffer[policies] for buffer in self.buffers()}
        return deepcopy(self, tensors)

    def adopt(self, policies: Tensor, part: Self) -> None:
        """Copy the parameters of `policies` (n,) from `part`, a result of `narrow`; normalisers excepted."""
        with torch.no_grad():
            for whole, narrowed in zip(self.learnable, part.learnable, strict=True):
                whole.index_copy_(0, policies, narrowed)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that the acting policy reads, by its names."""
        others: dict[str, Tensor] = {}
        if isinstance(self.network, RecurrentNetwork):
            units = ("weight_input", "weight_memory", "bias_input", "bias_memory")
            others = {f"gru_{name}": getattr(self.network, name) for name in units}
        if self.log_std is not None:
            others["log_std"] = self.log_std
        return acting_arrays(self.network, self.moments, others)

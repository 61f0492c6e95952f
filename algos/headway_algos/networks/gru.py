"""Stacked recurrent networks, with gated recurrent units between the hidden layers and the output layer.

The units are those of Cho et al. 2014, arXiv:1406.1078, in the variant of cuDNN and torch.nn.GRU, which
applies the reset gate after the product with the hidden state h:

    r = sigmoid(W_r x + b_r + U_r h),   z = sigmoid(W_z x + b_z + U_z h),
    c = tanh(W_c x + b_c + r (U_c h + b_h)),   h' = (1 - z) c + z h.

Only the candidate c has a second bias b_h; in the gates it would be redundant. Weights of r, z and c are
concatenated: (P, 3M, in).
"""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from headway.contracts import HeadwayError
from headway_algos.acting.mlp import layer_sizes
from headway_algos.networks.mlp import HIDDEN_GAIN, activated_layer, stacked_matrices
from headway_algos.networks.timeline import Timeline


def gated_step(from_input: Tensor, hidden: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return h' (P, M, n), given h and `from_input` W x + b (P, 3M, n); `weight` is U, `bias` is b_h."""
    size = hidden.shape[1]
    from_hidden = torch.bmm(weight, hidden)
    reset, update = torch.sigmoid(from_input[:, : 2 * size] + from_hidden[:, : 2 * size]).chunk(2, dim=1)
    candidate = torch.tanh(from_input[:, 2 * size :] + reset * (from_hidden[:, 2 * size :] + bias))
    return candidate + update * (hidden - candidate)


class RecurrentNetwork(nn.Module):
    """P networks of hidden layers, M gated recurrent units and an output layer.

    Initialised like `StackedMLP`; each of the units' matrices for r, z and c is orthogonal.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        networks_per_seed: int,
        purpose: str,
        sizes: tuple[int, Sequence[int], int],
        activation: str,
        last_gain: float,
        dtype: torch.dtype,
        units: int,
    ) -> None:
        super().__init__()
        self.activation = activation
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        input_size, hidden, outputs = sizes
        *layers, last = layer_sizes(input_size, hidden, units)
        gains = [HIDDEN_GAIN[activation]] * len(layers) + [last_gain]
        for i, (shape, gain) in enumerate(zip([*layers, (outputs, units)], gains, strict=True)):
            self.weights.append(stacked_matrices(seeds, networks_per_seed, purpose, i, shape, gain, dtype))
            self.biases.append(nn.Parameter(torch.zeros(len(self.weights[i]), shape[0], 1, dtype=dtype)))

        def gates(source: str, columns: int) -> nn.Parameter:
            parts = [
                stacked_matrices(
                    seeds, networks_per_seed, f"{purpose} gru {source}", gate, (units, columns), 1.0, dtype
                )
                for gate in range(3)
            ]
            return nn.Parameter(torch.cat([part.detach() for part in parts], dim=1))

        stack = len(seeds) * networks_per_seed
        self.weight_input, self.weight_memory = gates("input", last[1]), gates("memory", units)
        self.bias_input = nn.Parameter(torch.zeros(stack, 3 * units, 1, dtype=dtype))
        self.bias_memory = nn.Parameter(torch.zeros(stack, units, 1, dtype=dtype))

    def forward(self, rows: Tensor, timeline: Timeline | None = None) -> Tensor:
        """Return outputs (P, out, L x n) for rows (P, L x n, in): n sequences of L steps, step-major.

        Raises HeadwayError if `timeline` is None.
        """
        outputs: Tensor = torch.bmm(self.weights[-1], self.hidden_states(rows, timeline)) + self.biases[-1]
        return outputs

    def hidden_states(self, rows: Tensor, timeline: Timeline | None) -> Tensor:
        """Return the hidden states (P, M, L x n) after each of the rows (P, L x n, in).

        Raises HeadwayError if `timeline` is None.
        """
        if timeline is None:
            raise HeadwayError(
                "the update or critic does not pass the order of rows in time, which recurrence needs; "
                "use algo.model.core=none"
            )
        x = rows.transpose(1, 2)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = activated_layer(x, weight, bias, self.activation)
        from_input = torch.baddbmm(self.bias_input, self.weight_input, x)
        hidden, found = timeline.hidden, []
        width = hidden.shape[2]
        for now, continues, keeps in zip(
            _steps(from_input, width), _steps(timeline.continues, width), _steps(timeline.keeps, width),
            strict=False,
        ):  # fmt: skip
            assert now is not None
            before = hidden if continues is None else hidden * continues
            found.append(gated_step(now, before, self.weight_memory, self.bias_memory))
            hidden = found[-1] if keeps is None else torch.where(keeps, found[-1], before)
        return torch.cat(found, dim=2)


def _steps(rows: Tensor | None, width: int) -> Iterator[Tensor | None]:
    """Yield rows (P, ..., L x n) step by step; yield None forever if `rows` is None."""
    if rows is None:
        while True:
            yield None
    # The gradient of one split is assembled once; the gradient of each slice would be as large as `rows`.
    yield from torch.split(rows, width, dim=2)

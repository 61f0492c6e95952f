"""Forward and backward passes against torch's autograd."""

import pytest
import torch

from headway_algos.config import ModelConfig
from headway_algos.networks.gru import make_network
from headway_algos.networks.passes import forward_pass
from headway_algos.networks.timeline import Timeline

SEEDS, INPUTS, OUTPUTS, LENGTH, SEQUENCES = (0, 1, 2), 4, 2, 3, 5
ROWS = LENGTH * SEQUENCES
DOUBLE = torch.float64


@pytest.mark.parametrize(
    "model",
    [
        ModelConfig(hidden=(6, 5)),
        ModelConfig(hidden=(6, 5), activation="relu"),
        ModelConfig(hidden=()),
        ModelConfig(hidden=(6,), core="gru", gru_size=3),
    ],
)
def test_accumulated_gradients_equal_autograd(model: ModelConfig) -> None:
    network = make_network(model, SEEDS, 1, "passes", (INPUTS, OUTPUTS), 1.0, DOUBLE)
    random = torch.Generator().manual_seed(0)
    expected = [torch.zeros_like(parameter) for parameter in network.parameters()]
    for parameter in network.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=random, dtype=DOUBLE)
    for _ in range(2):
        rows = torch.randn(len(SEEDS), ROWS, INPUTS, generator=random, dtype=DOUBLE)
        slope = torch.randn(len(SEEDS), OUTPUTS, ROWS, generator=random, dtype=DOUBLE)
        timeline = None
        if model.core == "gru":
            memory = torch.randn(len(SEEDS), model.gru_size, SEQUENCES, generator=random, dtype=DOUBLE)
            timeline = Timeline(memory, torch.ones(len(SEEDS), 1, ROWS, dtype=DOUBLE), None)
        outputs = network(rows, timeline)
        gradients = torch.autograd.grad(outputs, list(network.parameters()), slope)
        expected = [total + part for total, part in zip(expected, gradients, strict=True)]
        passed = forward_pass(network, rows, timeline)
        assert not passed.outputs.requires_grad
        torch.testing.assert_close(passed.outputs, outputs.detach(), rtol=1e-12, atol=1e-12)
        passed.send_back(slope)
    for parameter, total in zip(network.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, total, rtol=1e-10, atol=1e-12)

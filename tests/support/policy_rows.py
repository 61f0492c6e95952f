"""Updates of stacked policies of one agent, random rows for them, and one policy alone for oracles."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Categorical, Independent, Normal, kl_divergence

from headway.contracts import Box, Discrete, EnvSpec
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.components import UPDATES
from headway_algos.config import AlgoConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.optim.fisher import from_vector, to_vector

D, A = 3, 3
DOUBLE = torch.float64
DISCRETE = EnvSpec("made", ("only",), D, Discrete(A), has_action_mask=True)
BOX = EnvSpec("made", ("only",), D, Box((-1.0,) * A, (1.0,) * A))
every_space = pytest.mark.parametrize("spec", [DISCRETE, BOX], ids=["discrete", "box"])


def update_of(config: AlgoConfig, spec: EnvSpec, stack: int) -> Any:  # noqa: ANN401 - one of UPDATES
    """Return the update that a configuration names."""
    layout = Layout(Grouping.of("shared", spec), stack, torch.device("cpu"), DOUBLE)
    return UPDATES[config.update].make(Actor(config.model, spec, range(stack), 1, DOUBLE), config, layout)


def random_rows(spec: EnvSpec, stack: int, count: int, seed: int = 1) -> tuple[PolicyBatch, Tensor]:
    """Return rows and their advantages. Some rows are not selected, and the last policy has at most six."""
    random = torch.Generator().manual_seed(seed)
    selected = (torch.rand(stack, count, generator=random) < 0.8).numpy()
    selected[-1, 6:] = False
    masks, actions = None, torch.randn(stack, count, A, generator=random, dtype=DOUBLE)
    if isinstance(spec.action_space, Discrete):
        allowed = torch.rand(stack, count, A, generator=random) < (0.8 if spec.has_action_mask else 2)
        allowed[..., 1] |= ~allowed.any(-1)
        actions = (allowed * torch.rand(stack, count, A, generator=random)).argmax(-1)
        masks = allowed if spec.has_action_mask else None
    observations = torch.randn(stack, count, D, generator=random, dtype=DOUBLE)
    moved, advantages = torch.randn(2, stack, count, generator=random, dtype=DOUBLE)
    return PolicyBatch(observations, masks, actions, 0.3 * moved - np.log(A), selected), advantages


def damped_kronecker(inputs: Tensor, signals: Tensor, damping: float) -> Tensor:
    """Return (A + pi sqrt(lambda) I) x (G + sqrt(lambda) / pi I) of one layer of one network."""
    pi = ((inputs.trace() / len(inputs)) / (signals.trace() / len(signals))).sqrt()
    one = inputs + pi * damping**0.5 * torch.eye(len(inputs), dtype=DOUBLE)
    return torch.kron(one, signals + damping**0.5 / pi * torch.eye(len(signals), dtype=DOUBLE))


class OnePolicy:
    """Policy p of a stack and its rows, by torch.distributions; its parameters are one vector (V,)."""

    def __init__(self, actor: Actor, rows: PolicyBatch, advantages: Tensor, p: int) -> None:
        self.actor = actor.narrow(torch.tensor([p]))
        chosen = np.flatnonzero(rows.selected[p])
        self.observations, self.actions = rows.observations[p, chosen], rows.actions[p, chosen]
        self.masks = None if rows.masks is None else rows.masks[p, chosen]
        self.behaviour, self.advantages = rows.log_probs[p, chosen], advantages[p, chosen]
        self.start = to_vector(parameter.detach() for parameter in self.actor.learnable)[0]

    def distribution(self, theta: Tensor, every: int = 1) -> Any:  # noqa: ANN401 - torch leaves it untyped
        """Return the distribution of each row, or of each `every`-th."""
        parts = [part[0] for part in from_vector(theta[None], self.actor.learnable)]
        log_std = parts.pop(0)[:, 0] if self.actor.log_std is not None else None
        layers, x = len(parts) // 2, self.observations[::every]
        for i in range(layers):
            x = x @ parts[i].T + parts[layers + i][:, 0]
            x = torch.tanh(x) if i < layers - 1 else x
        if log_std is not None:
            return Independent(Normal(x, log_std.exp().expand_as(x)), 1)
        return Categorical(logits=x if self.masks is None else x.masked_fill(~self.masks[::every], -400.0))

    def kl(self, theta: Tensor, every: int = 1) -> Tensor:
        """Return the mean divergence from the start."""
        result: Tensor = kl_divergence(self.distribution(self.start, every), self.distribution(theta, every))
        return result.mean()

    def fisher(self, every: int = 1) -> Tensor:
        """Return the Hessian of the divergence, (V, V)."""
        result: Tensor = torch.autograd.functional.hessian(lambda theta: self.kl(theta, every), self.start)
        return result

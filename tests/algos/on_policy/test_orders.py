"""The sequential order: the permutation, and the factor of each policy."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import pytest
import torch
from policy_rows import DOUBLE, A, D, random_rows
from torch import Tensor

from headway.contracts import Box, Discrete, EnvSpec, generator
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.components import UPDATES
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.sequential_order import sequential
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.on_policy.updates.kl_penalty import KLPenalty
from headway_algos.on_policy.updates.losses import PPOLoss
from headway_algos.registry import configure

R, N, B = 2, 4, 18
DISCRETE = EnvSpec("made", tuple("abcd"), D, Discrete(A))
APART = Grouping.of("independent", DISCRETE)
BOX = replace(DISCRETE, action_space=Box((-1.0,) * A, (1.0,) * A))
CONFIG = configure(
    "custom", order="sequential", model=ModelConfig(hidden=(6,), actor_gain=1.0), precision="float64",
    epochs=2, minibatches=3, lr=2e-2, piece_samples=16,
)  # fmt: skip


class Recording(GradientUpdate):
    """PPO that records each update: policies, advantages, and the resulting log-probabilities."""

    turns: list[tuple[list[int], Tensor, Tensor]]
    policies: list[int]

    def narrow(self, policies: Tensor) -> Self:
        part = super().narrow(policies)
        part.policies = policies.tolist()
        return part

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        info = super().improve(rows, advantages, generators)
        with torch.no_grad():
            log_probs = self.actor(rows.observations, rows.masks).log_prob(rows.actions)
        self.turns.append((self.policies, advantages.clone(), log_probs))
        return {**info, "policy": torch.tensor(self.policies, dtype=DOUBLE)}


def _update(kind: type[GradientUpdate], spec: EnvSpec, config: AlgoConfig = CONFIG) -> GradientUpdate:
    layout = Layout(APART, R, torch.device("cpu"), DOUBLE)
    actor = Actor(config.model, spec, range(R), N, DOUBLE)
    loss = PPOLoss(config.clip, config.entropy_coeff)
    penalty = None
    if config.kl_coeff > 0:
        coefficients = torch.full((R * N,), config.kl_coeff, dtype=DOUBLE)
        penalty = KLPenalty(coefficients, config.kl_target, config.piece_samples)
    return kind(actor, config, layout, loss, config.epochs, config.minibatches, penalty)


def _generators(purpose: str, count: int) -> list[np.random.Generator]:
    return [generator(i, purpose, 5) for i in range(count)]


@pytest.mark.parametrize("spec", [DISCRETE, BOX], ids=["discrete", "box"])
def test_advantages_are_weighted_by_the_ratios_of_agents_updated_before(spec: EnvSpec) -> None:
    """A naive product over agents, row by row; 1 where an agent was not acting."""
    update = _update(Recording, spec)
    assert isinstance(update, Recording)
    update.turns = []
    rows, advantages = random_rows(spec, R * N, B)
    info = sequential(update, APART, rows, advantages, _generators("rows", R * N), _generators("order", R))
    assert len(update.turns) == N
    for r, random in enumerate(_generators("order", R)):
        order = [r * N + agent for agent in random.permutation(N).tolist()]
        assert [policies[r] for policies, _, _ in update.turns] == order
        for m, (_, given, _) in enumerate(update.turns):
            for b in range(B):
                factor = 1.0
                for before, (_, _, log_probs) in zip(order[:m], update.turns, strict=False):
                    if rows.selected[before, b]:
                        factor *= float((log_probs[r, b] - rows.log_probs[before, b]).exp())
                assert float(given[r, b]) == pytest.approx(factor * float(advantages[order[m], b]), rel=1e-10)
    assert info["policy"].tolist() == list(range(R * N))


def test_the_state_of_an_update_is_adopted_from_its_part() -> None:
    """Moments and coefficients after two updates are as if each policy had its own update."""
    rows, advantages = random_rows(DISCRETE, R * N, B)
    config = replace(CONFIG, kl_coeff=0.3)
    whole, parts = _update(GradientUpdate, DISCRETE, config), _update(GradientUpdate, DISCRETE, config)
    for _ in range(2):
        whole.improve(rows, advantages, _generators("rows", R * N))
        for p in reversed(range(R * N)):
            policies = torch.tensor([p])
            part = parts.narrow(policies)
            part.improve(rows.narrow(policies), advantages[policies], [_generators("rows", R * N)[p]])
            parts.adopt(policies, part)
    assert parts.penalty is not None
    assert whole.penalty is not None
    adapted = whole.penalty.coefficients
    torch.testing.assert_close(parts.penalty.coefficients, adapted, rtol=1e-12, atol=0)
    assert (adapted != 0.3).any()
    assert parts.optimiser.counts.tolist() == whole.optimiser.counts.tolist() == [12] * (R * N)
    pairs = zip(
        [*parts.actor.parameters(), *parts.optimiser.means.parts, *parts.optimiser.squares.parts],
        [*whole.actor.parameters(), *whole.optimiser.means.parts, *whole.optimiser.squares.parts],
        strict=True,
    )
    for mine, theirs in pairs:
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("update", UPDATES)
def test_a_part_is_a_copy_until_it_is_adopted(update: Any) -> None:  # noqa: ANN401 - a literal
    shared = {"order": "sequential", "model": CONFIG.model, "precision": "float64"}
    config = configure("custom", update=update, **shared, **({"lr": 2e-2} if update != "trpo" else {}))
    layout = Layout(APART, R, torch.device("cpu"), DOUBLE)
    whole = UPDATES[update].make(Actor(config.model, DISCRETE, range(R), N, DOUBLE), config, layout)
    rows, advantages = random_rows(DISCRETE, R * N, B)
    before = [parameter.detach().clone() for parameter in whole.actor.parameters()]
    policies = torch.tensor([6, 1])
    part = whole.narrow(policies)
    part.improve(rows.narrow(policies), advantages[policies], _generators("rows", 2))
    for old, new in zip(before, whole.actor.parameters(), strict=True):
        assert torch.equal(new, old)
    whole.adopt(policies, part)
    for old, new, own in zip(before, whole.actor.parameters(), part.actor.parameters(), strict=True):
        assert torch.equal(new[[6, 1]], own)
        assert not torch.equal(new[6], old[6])
        for p in (0, 2, 3, 4, 5, 7):
            assert torch.equal(new[p], old[p])

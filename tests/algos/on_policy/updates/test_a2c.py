"""A2C's single step against a loop over rows, and the whole batch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, Normal

from headway.contracts import Box, Discrete, EnvSpec, generator
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.updates.gradient_update import GradientUpdate, a2c_update
from headway_algos.registry import configure

P, B, D, A = 3, 20, 4, 3
DOUBLE = torch.float64
DISCRETE = EnvSpec("made", ("only",), D, Discrete(A), has_action_mask=True)
BOX = EnvSpec("made", ("only",), D, Box((-1.0,) * A, (1.0,) * A))
CONFIG = configure(
    "custom",
    update="a2c",
    model=ModelConfig(hidden=(6,), actor_gain=1.0),
    precision="float64",
    lr=1e-2,
    entropy_coeff=0.3,
    grad_clip=None,
    piece_samples=12,
)


def _selected() -> NDArray[np.bool_]:
    selected = np.random.default_rng(0).random((P, B)) < 0.6
    selected[2, :15] = False
    return selected


def _rows(spec: EnvSpec, selected: NDArray[np.bool_], seed: int = 1) -> tuple[PolicyBatch, Tensor]:
    random = torch.Generator().manual_seed(seed)
    masks, actions = None, torch.randn(P, B, A, generator=random, dtype=DOUBLE)
    if spec is DISCRETE:
        masks = torch.rand(P, B, A, generator=random) < 0.7
        masks[..., 1] |= ~masks.any(-1)
        actions = (masks * torch.rand(P, B, A, generator=random)).argmax(-1)
    log_probs = torch.randn(P, B, generator=random, dtype=DOUBLE)
    advantages = torch.randn(P, B, generator=random, dtype=DOUBLE)
    observations = torch.randn(P, B, D, generator=random, dtype=DOUBLE)
    return PolicyBatch(observations, masks, actions, log_probs, selected), advantages


def _update(spec: EnvSpec, config: AlgoConfig) -> GradientUpdate:
    layout = Layout(Grouping.of("shared", spec), P, torch.device("cpu"), DOUBLE)
    return a2c_update(Actor(config.model, spec, range(P), 1, DOUBLE), config, layout)


@pytest.mark.parametrize(("spec", "clip"), [(DISCRETE, None), (BOX, 0.1)])
def test_steps_equal_those_on_a_loss_summed_row_by_row(spec: EnvSpec, clip: float | None) -> None:
    """-E[log pi A] - c_e H over selected rows, by torch.distributions and torch.optim.Adam; two steps, so
    that moments are carried over."""
    config = replace(CONFIG, grad_clip=clip)
    update, selected = _update(spec, config), _selected()
    naive = Actor(config.model, spec, range(P), 1, DOUBLE)
    alone = [naive.narrow(torch.tensor([p])) for p in range(P)]
    adams = [torch.optim.Adam(actor.parameters(), config.lr, eps=1e-5) for actor in alone]
    for seed in (1, 2):
        rows, advantages = _rows(spec, selected, seed)
        info = update.improve(rows, advantages, [])
        for p, (actor, adam) in enumerate(zip(alone, adams, strict=True)):
            loss, total = torch.zeros((), dtype=DOUBLE), 0.0
            chosen = np.flatnonzero(selected[p]).tolist()
            for b in chosen:
                outputs = actor.network(rows.observations[p : p + 1, b : b + 1])[0, :, 0]
                if actor.log_std is None:
                    assert rows.masks is not None
                    one = Categorical(logits=outputs.masked_fill(~rows.masks[p, b], -400.0))
                else:
                    one = Independent(Normal(outputs, actor.log_std.exp()[0, :, 0]), 1)
                entropy = one.entropy()
                loss = loss - one.log_prob(rows.actions[p, b]) * advantages[p, b] - 0.3 * entropy
                total += float(entropy.detach())
            adam.zero_grad()
            (loss / len(chosen)).backward()
            norm = nn.utils.clip_grad_norm_(actor.parameters(), clip or float("inf"))
            adam.step()
            assert float(info["gradient_norm"][p]) == pytest.approx(float(norm), rel=1e-10)
            assert float(info["entropy"][p]) == pytest.approx(total / len(chosen), rel=1e-10)
    for p, actor in enumerate(alone):
        for mine, theirs in zip(update.actor.parameters(), actor.parameters(), strict=True):
            torch.testing.assert_close(mine[p], theirs[0], rtol=1e-10, atol=1e-10)


def test_epochs_and_minibatches_do_not_apply_to_the_actor() -> None:
    results = []
    for epochs, minibatches in ((1, 1), (7, 5)):
        update = _update(DISCRETE, replace(CONFIG, epochs=epochs, minibatches=minibatches))
        rows, advantages = _rows(DISCRETE, _selected())
        update.improve(rows, advantages, [generator(p, "test") for p in range(P)])
        results.append([parameter.detach().clone() for parameter in update.actor.parameters()])
        assert update.optimiser.counts.tolist() == [1, 1, 1]
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


def test_a_policy_without_rows_stays_unchanged() -> None:
    update, selected = _update(DISCRETE, CONFIG), _selected()
    for turn in (selected, selected & (np.arange(P) != 1)[:, None], np.zeros_like(selected)):
        before = [parameter.detach().clone() for parameter in update.actor.parameters()]
        rows, advantages = _rows(DISCRETE, turn)
        info = update.improve(rows, advantages, [])
        for value in info.values():
            assert torch.isfinite(value).tolist() == turn.any(axis=1).tolist()
        for old, new in zip(before, update.actor.parameters(), strict=True):
            for p in range(P):
                assert torch.equal(old[p], new[p]) == (not turn[p].any())
    assert update.optimiser.counts.tolist() == [2, 1, 2]


def test_a_whole_batch_holds_every_selected_row_once_and_pads_with_weight_zero() -> None:
    selected = _selected()
    selected[1] = False
    rows, advantages = _rows(DISCRETE, selected)
    batch = WholeBatch.of(rows, advantages)
    assert batch.weight.shape[1] == selected.sum(1).max()
    assert batch.has_rows.tolist() == [True, False, True]
    for p in range(P):
        chosen, count = np.flatnonzero(selected[p]), int(selected[p].sum())
        assert batch.row_index[p, :count].tolist() == chosen.tolist()
        assert torch.equal(batch.observations[p, :count], rows.observations[p, chosen])
        assert torch.equal(batch.actions[p, :count], rows.actions[p, chosen])
        assert torch.equal(batch.log_probs[p, :count], rows.log_probs[p, chosen])
        assert torch.equal(batch.advantages[p, :count], advantages[p, chosen])
        assert batch.masks is not None
        assert rows.masks is not None
        assert torch.equal(batch.masks[p, :count], rows.masks[p, chosen])
        torch.testing.assert_close(
            batch.weight[p, :count], torch.full((count,), 1 / max(count, 1), dtype=DOUBLE)
        )
        assert (batch.weight[p, count:] == 0).all()
        if count:  # rows of others' places may hold anything
            assert np.isin(batch.row_index[p].numpy(), chosen).all()


def test_pieces_of_a_whole_batch_are_its_rows_in_order() -> None:
    rows, advantages = _rows(DISCRETE, _selected())
    batch = WholeBatch.of(rows, advantages)
    pieces = list(batch.pieces(12))
    assert len(pieces) > 2
    assert all(piece.weight.numel() <= 12 for piece in pieces)
    assert torch.equal(torch.cat([piece.row_index for piece in pieces], 1), batch.row_index)
    assert torch.equal(torch.cat([piece.weight for piece in pieces], 1), batch.weight)


def test_every_nth_row_of_each_policy_has_the_weight_of_all() -> None:
    selected = _selected()
    selected[1] = False
    rows, advantages = _rows(DISCRETE, selected)
    batch = WholeBatch.of(rows, advantages)
    third = batch.strided(3)
    for p in range(P):
        chosen = np.flatnonzero(selected[p])[::3]
        assert third.row_index[p, : len(chosen)].tolist() == chosen.tolist()
        expected = torch.full((len(chosen),), 1 / max(len(chosen), 1), dtype=DOUBLE)
        torch.testing.assert_close(third.weight[p, : len(chosen)], expected)
        assert (third.weight[p, len(chosen) :] == 0).all()

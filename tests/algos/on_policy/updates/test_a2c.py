"""A2C's single step against a loop over rows, and the whole batch."""

from dataclasses import replace

import numpy as np
import torch
from policy_rows import DISCRETE, DOUBLE, random_rows, update_of

from headway.contracts import generator
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.config import ModelConfig
from headway_algos.registry import configure

P, B = 3, 20
CONFIG = configure(
    "custom", update="a2c", model=ModelConfig(hidden=(6,), actor_gain=1.0), precision="float64", lr=1e-2,
)  # fmt: skip


def test_epochs_and_minibatches_do_not_apply_to_the_actor() -> None:
    results = []
    for epochs, minibatches in ((1, 1), (7, 5)):
        update = update_of(replace(CONFIG, epochs=epochs, minibatches=minibatches), DISCRETE, P)
        rows, advantages = random_rows(DISCRETE, P, B)
        update.improve(rows, advantages, [generator(p, "test") for p in range(P)])
        results.append([parameter.detach().clone() for parameter in update.actor.parameters()])
        assert update.optimiser.counts.tolist() == [1, 1, 1]
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


def test_a_whole_batch_holds_every_selected_row_once_and_pads_with_weight_zero() -> None:
    rows, advantages = random_rows(DISCRETE, P, B)
    selected = rows.selected
    selected[1] = False
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
    batch = WholeBatch.of(*random_rows(DISCRETE, P, B))
    pieces = list(batch.pieces(12))
    assert len(pieces) > 2
    assert all(piece.weight.numel() <= 12 for piece in pieces)
    assert torch.equal(torch.cat([piece.row_index for piece in pieces], 1), batch.row_index)
    assert torch.equal(torch.cat([piece.weight for piece in pieces], 1), batch.weight)


def test_every_nth_row_of_each_policy_has_the_weight_of_all() -> None:
    rows, advantages = random_rows(DISCRETE, P, B)
    selected = rows.selected
    selected[1] = False
    batch = WholeBatch.of(rows, advantages)
    third = batch.strided(3)
    for p in range(P):
        chosen = np.flatnonzero(selected[p])[::3]
        assert third.row_index[p, : len(chosen)].tolist() == chosen.tolist()
        expected = torch.full((len(chosen),), 1 / max(len(chosen), 1), dtype=DOUBLE)
        torch.testing.assert_close(third.weight[p, : len(chosen)], expected)
        assert (third.weight[p, len(chosen) :] == 0).all()

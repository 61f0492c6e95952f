"""Rows by policy, minibatches and truncations."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_trajectories import fabricate
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Discrete, EnvSpec, Trajectory, TrajectoryLayout, generator
from headway_algos.batches import minibatches as minibatches_module
from headway_algos.batches.layout import Layout, zero_where_absent
from headway_algos.batches.minibatches import minibatches
from headway_algos.batches.stream_ends import Truncations
from headway_algos.grouping import Grouping

SPEC = EnvSpec("made", tuple("abcdef"), 3, Discrete(2), state_size=2, groups=tuple("xyxzxz"))
STEPS, COPIES, REPLICAS = 4, 3, 2


def _layout(policies: str) -> Layout:
    return Layout(Grouping.of(policies, SPEC), REPLICAS, torch.device("cpu"), torch.float64)


@pytest.mark.parametrize("policies", ["independent", "shared", "groups"])
def test_rows_are_ordered_by_agent_step_and_copy(policies: str) -> None:
    layout = _layout(policies)
    values = np.random.default_rng(0).normal(size=(STEPS, REPLICAS * COPIES, 6, 2))
    rows = layout.rows(values)
    selected = layout.selection(np.ones(values.shape[:3], np.bool_))
    for r in range(REPLICAS):
        for k, members in enumerate(layout.grouping.members.tolist()):
            p = r * layout.grouping.num_policies + k
            expected = [
                values[t, r * COPIES + e, n]
                for n in members
                if n >= 0
                for t in range(STEPS)
                for e in range(COPIES)
            ]
            np.testing.assert_array_equal(rows[p].numpy()[selected[p]], expected)
    np.testing.assert_array_equal(layout.by_agent(rows, STEPS), values)


def test_rows_of_the_first_agents_of_a_shared_policy_convert_back() -> None:
    layout, values = _layout("shared"), np.arange(STEPS * REPLICAS * COPIES * 2.0)
    by_agent = values.reshape(STEPS, REPLICAS * COPIES, 2)
    np.testing.assert_array_equal(layout.by_agent(layout.rows(by_agent), STEPS, agents=2), by_agent)


@pytest.mark.parametrize("policies", ["independent", "groups"])
def test_a_subset_of_agents_needs_a_shared_policy(policies: str) -> None:
    layout = _layout(policies)
    rows = layout.rows(np.zeros((STEPS, REPLICAS * COPIES, 6)))
    with pytest.raises(ValueError, match="agents must be None with"):
        layout.by_agent(rows, STEPS, agents=2)


def test_groups_are_those_the_environment_names() -> None:
    members = Grouping.of("groups", SPEC).members
    assert members.tolist() == [[0, 2, 4], [1, -1, -1], [3, 5, -1]]


def _batches(
    selected: NDArray[np.bool_], epochs: int, parts: int, piece_rows: int
) -> list[list[tuple[NDArray[np.int64], Tensor]]]:
    """Pieces of each minibatch as (rows per network (P, rows), weights (P, rows)), with about `piece_rows`
    rows per network."""
    stack, batch = selected.shape
    generators = [generator(p, "test") for p in range(stack)]
    result = []
    samples = piece_rows * stack
    for pieces, active in minibatches(selected, generators, epochs, parts, samples, _layout("shared")):
        decoded = []
        assert active.tolist() == [any(piece.weight[p].any() for piece in pieces) for p in range(stack)]
        for piece in pieces:
            index = piece.index.numpy().reshape(stack, -1)
            assert (index // batch == np.arange(stack)[:, None]).all(), "a row of another network"
            decoded.append((index % batch, piece.weight))
        result.append(decoded)
    return result


@pytest.mark.parametrize("piece_rows", [3, 1000])
@pytest.mark.parametrize("parts", [1, 4, 7])
def test_an_epoch_covers_every_selected_row_once_and_no_other(parts: int, piece_rows: int) -> None:
    selected = np.random.default_rng(0).random((3, 40)) < [[0.9], [0.5], [0.05]]
    batches = _batches(selected, 2, parts, piece_rows)
    assert len(batches) == 2 * parts
    orders = []
    for epoch in (batches[:parts], batches[parts:]):
        for p in range(3):
            used = [
                int(row)
                for pieces in epoch
                for index, weight in pieces
                for row, w in zip(index[p], weight[p], strict=True)
                if w > 0
            ]
            assert sorted(used) == np.flatnonzero(selected[p]).tolist()
            orders.append(used)
    assert (orders[0] == orders[3]) == (parts == 1), "epochs are shuffled anew, a whole batch is not"


def test_weights_of_a_minibatch_average_its_rows() -> None:
    selected = np.random.default_rng(1).random((3, 40)) < [[0.9], [0.5], [0.05]]
    for pieces in _batches(selected, 1, 4, 5):
        for p in range(3):
            weights = torch.cat([weight[p] for _, weight in pieces])
            used = weights[weights > 0]
            if len(used):
                torch.testing.assert_close(used, torch.full_like(used, 1 / len(used)))


def test_minibatches_have_nearly_equal_sizes() -> None:
    selected = np.ones((1, 30), np.bool_)
    sizes = [sum(int((w > 0).sum()) for _, w in pieces) for pieces in _batches(selected, 1, 4, 1000)]
    assert sum(sizes) == 30
    assert max(sizes) - min(sizes) <= 1


def test_padding_repeats_a_networks_own_selected_rows() -> None:
    """A weight of 0 does not undo a NaN, so rows that were not selected must not be read at all."""
    selected = np.zeros((2, 20), np.bool_)
    selected[0], selected[1, 13:16] = True, True
    for pieces in _batches(selected, 3, 2, 6):
        for index, _ in pieces:
            assert selected[1, index[1]].all()


def test_truncations_are_found_and_inserted_back() -> None:
    made = fabricate(SPEC, 10, REPLICAS * COPIES, seed=5, ends=0.2, leaves=0.05)
    made.truncated[:, :COPIES] = False  # replicas differ in how many there are
    made.truncated[3, 1] = True
    made.terminated[3, 1] = False
    truncations = Truncations.of(made, REPLICAS)
    values = made.final_observations[..., 0].astype(np.float64)
    back = truncations.put(truncations.take(values), values.shape)
    cut = (made.truncated & ~made.terminated).any(axis=2)
    np.testing.assert_array_equal(back[cut], values[cut])
    assert (back[~cut] == 0).all()


def test_no_truncations() -> None:
    made = Trajectory.allocate(TrajectoryLayout(SPEC, 4, REPLICAS * COPIES))
    truncations = Truncations.of(made, REPLICAS)
    assert len(truncations) == 0
    assert truncations.take(made.final_states).shape == (0, REPLICAS, 2)
    assert (truncations.put(np.zeros((0, REPLICAS, 6)), made.rewards.shape) == 0).all()


@pytest.mark.parametrize(
    ("policies", "agents"), [("independent", 6), ("shared", 1), ("shared", 6), ("groups", 6)]
)
def test_absent_rows_become_zero_and_the_source_is_unchanged(policies: str, agents: int) -> None:
    spec = replace(SPEC, agents=SPEC.agents[:agents], groups=SPEC.groups[:agents])
    layout = Layout(Grouping.of(policies, spec), 1, torch.device("cpu"), torch.float32)
    random = np.random.default_rng(0)
    values = random.normal(size=(5, 1, agents, 4)).astype(np.float32)
    present = random.random((5, 1, agents)) < 0.5
    values[~present] = np.nan
    before = values.copy()
    cleaned = zero_where_absent(values, present)
    np.testing.assert_array_equal(cleaned, np.where(present[..., None], values, 0))
    assert torch.equal(layout.rows(values, present), layout.rows(cleaned))
    assert np.array_equal(values, before, equal_nan=True)


def test_an_unknown_value_of_policies_is_refused() -> None:
    with pytest.raises(ValueError, match="independent, shared or groups, not 'group'"):
        Grouping.of("group", SPEC)


@pytest.mark.parametrize("piece_rows", [5, 1000])
def test_prefetched_rows_are_those_of_minibatches(monkeypatch: pytest.MonkeyPatch, piece_rows: int) -> None:
    """Prefetching is tested for several tensors, in blocks that divide the minibatches and in others."""
    selected = np.random.default_rng(4).random((3, 40)) < [[0.9], [0.5], [0.05]]
    rows = [torch.from_numpy(np.random.default_rng(5).normal(size=(3, 40, *more))) for more in ((2,), ())]
    generators = [generator(p, "test") for p in range(3)]
    monkeypatch.setattr(minibatches_module, "PREFETCH_SAMPLES", 3 * 9 * 3)
    ahead = 0
    for pieces, _ in minibatches(selected, generators, 2, 4, 3 * piece_rows, _layout("shared")):
        for piece in pieces:
            ahead += piece.prefetched is not None
            for tensor in rows:
                assert torch.equal(piece.of(tensor), tensor.flatten(0, 1)[piece.index])
    assert ahead == (8 if piece_rows == 1000 else 0)

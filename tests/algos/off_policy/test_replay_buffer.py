"""Replay memories: what they hold, what they draw, what they save."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, generator
from headway_algos.off_policy.replay_buffer import ReplayBuffer
from headway_algos.off_policy.transitions import Transitions

SPEC = EnvSpec("made", ("a", "b"), 2, Discrete(3), has_action_mask=True)
CAPACITY, POLICIES = 6, 3


def _numbered(numbers: NDArray[np.int64], spec: EnvSpec = SPEC) -> Transitions:
    """Transitions that say everywhere which they are."""
    as_float = numbers.astype(np.float64)
    two = np.stack([as_float, -as_float], axis=1).astype(np.float32)
    box = isinstance(spec.action_space, Box)
    return Transitions(
        numbers,
        two,
        two[:, :1] if box else numbers,
        as_float,
        as_float / 100,
        two + 0.5,
        np.ones((len(numbers), 3 if spec.has_action_mask else 0), np.bool_),
    )


def _buffer(capacity: int = CAPACITY, spec: EnvSpec = SPEC) -> ReplayBuffer:
    return ReplayBuffer(spec, POLICIES, capacity, torch.device("cpu"))


def _held(buffer: ReplayBuffer) -> list[list[float]]:
    """Return the stored numbers of each policy, sorted."""
    by_policy = buffer.arrays["returns"].numpy().reshape(POLICIES, buffer.capacity)
    return [sorted(row[:count].tolist()) for row, count in zip(by_policy, buffer.filled, strict=True)]


def test_each_policy_holds_its_own_newest_and_no_others() -> None:
    random, buffer = np.random.default_rng(0), _buffer()
    lived: list[list[float]] = [[] for _ in range(POLICIES)]
    number = 0
    for count in (2, 0, 5, 1, 30, 3, 7):
        owners = random.choice(POLICIES, count, p=[0.6, 0.4, 0.0])
        numbers = np.arange(number, number + count)
        number += count
        buffer.add(owners, _numbered(numbers))
        for owner, one in zip(owners, numbers, strict=True):
            lived[owner].append(float(one))
        assert _held(buffer) == [sorted(all_of[-CAPACITY:]) for all_of in lived]
    assert buffer.filled.tolist() == [CAPACITY, CAPACITY, 0]


def test_batches_hold_whole_transitions_and_no_holes() -> None:
    buffer = _buffer()
    buffer.add(np.array([0, 0, 0, 1]), _numbered(np.array([5, 6, 7, 8])))
    random = [generator(0, "replay", k) for k in range(POLICIES)]
    places = buffer.draws(random, np.array([True, True, False]), (4, 50))
    assert places.shape == (4, POLICIES, 50)
    batch = buffer.batch(places[0], torch.float64)
    assert set(batch.returns[0].tolist()) == {5.0, 6.0, 7.0}
    assert set(batch.returns[1].tolist()) == {8.0}
    assert not batch.returns[2].any()
    for policy in (0, 1):
        number = batch.returns[policy]
        np.testing.assert_array_equal(batch.actions[policy], number)
        np.testing.assert_array_equal(batch.observations[policy], torch.stack([number, -number], 1))
        np.testing.assert_array_equal(batch.discounts[policy], number / 100)
        np.testing.assert_array_equal(batch.next_observations[policy, :, 0], number + 0.5)
    assert batch.next_masks is not None
    assert batch.next_masks[:2].all()


@pytest.mark.parametrize("lived", [40, 100, 1234])
def test_draws_are_uniform_over_what_is_held(lived: int) -> None:
    """Chi-squared within 5 standard deviations, before the memory is full, when it is, and long after."""
    buffer, draws = _buffer(100), 200_000
    for first in range(0, lived, 7):
        numbers = np.arange(first, min(first + 7, lived))
        buffer.add(np.zeros(len(numbers), np.int64), _numbered(numbers))
    random = [generator(3, "replay", k) for k in range(POLICIES)]
    places = buffer.draws(random, np.array([True, False, False]), (1, draws))
    drawn = buffer.batch(places[0], torch.float64).returns[0].numpy().astype(int)
    held = min(lived, 100)
    counts = np.bincount(drawn, minlength=lived)
    assert not counts[: lived - held].any()
    expected = draws / held
    chi_squared = ((counts[lived - held :] - expected) ** 2 / expected).sum()
    assert abs(chi_squared - (held - 1)) < 5 * np.sqrt(2 * (held - 1))


@pytest.mark.parametrize(("lived", "space"), [(3, Discrete(3)), (20, Box((-1.0,), (1.0,)))])
def test_a_saved_buffer_restores_and_continues_identically(lived: int, space: Any) -> None:  # noqa: ANN401
    spec = replace(SPEC, action_space=space, has_action_mask=isinstance(space, Discrete))
    buffer, other = _buffer(spec=spec), _buffer(spec=spec)
    buffer.add(np.arange(lived) % 2, _numbered(np.arange(lived), spec))
    state = buffer.state_dict()
    assert len(state["arrays"]["returns"]) == buffer.filled.sum() <= 2 * CAPACITY
    other.load_state_dict(state)
    for each in (buffer, other):
        each.add(np.array([0, 1, 1, 2]), _numbered(np.arange(90, 94), spec))
    for name, array in buffer.arrays.items():
        assert torch.equal(array, other.arrays[name]), name
    assert buffer.filled.tolist() == other.filled.tolist()

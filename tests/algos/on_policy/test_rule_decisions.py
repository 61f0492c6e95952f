"""The sample of a rule's decisions."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.on_policy import rule_decisions
from headway_algos.on_policy.rule_decisions import RuleDecisions


@pytest.fixture(autouse=True)
def _capacity() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rule_decisions, "CAPACITY", 600)
        patch.setattr(rule_decisions, "LEAST", 1)
        yield


def _batch(first: int, selected: np.ndarray) -> PolicyBatch:
    """Rows whose observation, three times, action and number are one; those of policy 1 are 1,000 higher."""
    numbers = first + torch.arange(selected.shape[1]).float() + 1_000 * torch.arange(2)[:, None]
    masks = torch.ones(*numbers.shape, 3, dtype=torch.bool)
    return PolicyBatch(
        numbers[..., None].repeat(1, 1, 3), masks, numbers.long(), torch.zeros_like(numbers), selected
    )


def _numbers(decisions: RuleDecisions, policy: int) -> list[int]:
    rows = decisions.rows(None, torch.device("cpu"))
    selected = torch.from_numpy(rows.selected[policy])
    assert (rows.observations[policy, selected, 0].long() == rows.actions[policy, selected]).all()
    return rows.actions[policy, selected].tolist()


def test_all_are_kept_up_to_the_capacity_and_only_selected_ones() -> None:
    decisions, selected = RuleDecisions(1, 2, 3), np.ones((2, 40), np.bool_)
    selected[1, ::2] = False
    for first in (0, 40):
        decisions.include(_batch(first, selected), [np.random.default_rng(p) for p in range(2)])
    assert _numbers(decisions, 0) == list(range(80))
    assert _numbers(decisions, 1) == list(range(1001, 1080, 2))


def test_each_is_kept_with_the_same_probability() -> None:
    """100 of 400 are kept: of each of 4 iterations 25 on average, with variance 25 x (3/4) x (300/399)."""
    counts = np.zeros(4)
    repeats = 200
    for repeat in range(repeats):
        decisions = RuleDecisions(1, 2, 3)
        generators = [np.random.default_rng([repeat, p]) for p in range(2)]
        for first in range(0, 400, 100):
            decisions.include(_batch(first, np.ones((2, 100), np.bool_)), generators)
        kept = _numbers(decisions, 0)
        assert len(kept) == len(set(kept)) == 100
        counts += np.bincount(np.array(kept) // 100, minlength=4)
    error = np.sqrt(25 * 0.75 * 300 / 399 / repeats)
    assert np.abs(counts / repeats - 25).max() < 4 * error

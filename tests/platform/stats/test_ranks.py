"""Ranks over tasks against Demsar's example, enumeration and scipy."""

from itertools import permutations, product

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from headway.stats import frames
from headway.stats.ranks import friedman, groups, ranks, signed_rank_p_value

DEMSAR = np.array(
    [
        [4, 3, 2, 1], [1, 2, 3, 4], [4, 1, 2, 3], [4, 1, 3, 2], [4, 2, 3, 1], [1, 2.5, 4, 2.5], [3, 2, 4, 1],
        [2.5, 2.5, 4, 1], [4, 3, 2, 1], [2.5, 2.5, 2.5, 2.5], [4, 2.5, 1, 2.5], [3, 2, 4, 1], [4, 1, 2, 3],
        [3, 1, 4, 2],
    ]
)  # fmt: skip
"""Ranks of four variants of C4.5 on 14 data sets: Demsar 2006, table 6."""


def test_ranks_and_friedmans_statistic_are_demsars() -> None:
    assert ranks(-DEMSAR).tolist() == DEMSAR.tolist()
    assert ranks(-DEMSAR).mean(axis=0) == pytest.approx([3.143, 2.000, 2.893, 1.964], abs=5e-4)
    found = friedman(-DEMSAR)
    assert found.statistic == pytest.approx(9.28, abs=0.005)
    # His F of 3.69 with 3 and 39 degrees of freedom, without a correction for ties, has p = 0.020.
    assert found.p_value == pytest.approx(float(stats.f.sf(3.69, 3, 39)), abs=0.01)


@pytest.mark.parametrize(
    "table", [[[3, 2, 1]] * 3, [[3, 2, 1], [3, 1, 2]], [[3, 2, 1], [1, 2, 3], [2, 2, 1]]]
)
def test_friedmans_p_is_the_share_of_all_orders(table: list[list[float]]) -> None:
    placed = ranks(table)
    orders = [list(permutations(row)) for row in placed]
    spread = [np.square(np.mean(rows, axis=0) - 2).sum() for rows in product(*orders)]
    expected = np.mean(np.array(spread) >= np.square(placed.mean(axis=0) - 2).sum() - 1e-9)
    assert friedman(table).p_value == pytest.approx(expected, abs=0.015)


@pytest.mark.parametrize(
    "values", [[1, -2, 2, 3, 0], [1, 1, 1], [-3, 1, 2.5, 4, 5, -0.5], [2], [4, 4, -4, 0]]
)
def test_wilcoxons_p_is_the_share_of_all_signs(values: list[float]) -> None:
    known = [value for value in values if value]
    placed = stats.rankdata(np.abs(known))
    sums = [abs(np.dot(signs, placed)) for signs in product((1, -1), repeat=len(known))]
    expected = np.mean(np.array(sums) >= abs(np.dot(np.sign(known), placed)))
    assert signed_rank_p_value(values) == pytest.approx(expected)


def test_wilcoxons_p_is_scipys_without_ties() -> None:
    generator = np.random.default_rng(0)
    for count in (3, 9, 30):
        values = generator.normal(0.3, 1, count)
        assert signed_rank_p_value(values) == pytest.approx(stats.wilcoxon(values, method="exact").pvalue)
    assert signed_rank_p_value([0.0, 0.0]) == 1.0


def test_bars_join_neighbours_of_which_no_two_differ() -> None:
    differ = {(0, 2), (0, 3), (0, 4), (1, 4), (2, 4), (3, 4)}
    assert groups(5, lambda i, j: (i, j) in differ) == [(0, 1), (1, 3)]
    assert groups(3, lambda i, j: False) == [(0, 2)]
    assert groups(3, lambda i, j: True) == []


def test_frames_of_ranks_are_ordered_by_the_average() -> None:
    scores = pd.DataFrame({"a": [1.0, 2.0, 0.5], "b": [2.0, 3.0, 0.0], "c": [0.0, 0.0, -1.0]}, list("xyz"))
    found = frames.rank_table(scores)
    assert found["average_rank"].to_dict() == pytest.approx({"b": 4 / 3, "a": 5 / 3, "c": 3})
    assert found.loc["a", ["x", "y", "z"]].tolist() == [2, 2, 1]
    pairs = frames.rank_pairs(scores)
    assert pairs[["a", "b"]].to_numpy().tolist() == [["b", "a"], ["b", "c"], ["a", "c"]]
    assert pairs["p"].tolist() == [0.5, 0.25, 0.25]  # -0.5 is the smallest of three; all signs are equal
    assert pairs["p_holm"].tolist() == [0.75, 0.75, 0.75]

"""Parametrisations without the cost of all combinations: covering sets, and cases for the full run only."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations, product
from typing import Any

import pytest
from _pytest.mark import ParameterSet


def pairwise(*axes: Iterable[Any], where: Callable[..., bool] = lambda *row: True) -> list[tuple[Any, ...]]:
    """Return rows, one value per axis, in which any two values of different axes meet at least once.

    `where` admits combinations; a pair that no admitted combination holds is left out. Greedy and
    deterministic: the first combination with most uncovered pairs is taken until no pair is left. Faults that
    two parameters cause together are found as by the full product (Kuhn, Wallace and Gallo, "Software fault
    interactions and implications for software testing", 2004).
    """
    rows = [row for row in product(*map(list, axes)) if where(*row)]
    pairs_of = {row: frozenset(combinations(enumerate(row), 2)) for row in rows}
    uncovered, chosen = frozenset[Any]().union(*pairs_of.values()), []
    while uncovered:
        best = max(pairs_of, key=lambda row: len(pairs_of[row] & uncovered))
        uncovered -= pairs_of.pop(best)
        chosen.append(best)
    return chosen


def quick_or_slow(cases: Mapping[str, Sequence[Any]], *quick: str) -> list[ParameterSet]:
    """Return named cases as parameters, marked `slow` except those named `quick`, which show each kind."""
    assert set(quick) <= set(cases)
    marks = {name: () if name in quick else (pytest.mark.slow,) for name in cases}
    return [pytest.param(*values, id=name, marks=marks[name]) for name, values in cases.items()]

"""The covering sets by which tests are parametrised."""

from itertools import combinations, product

from covering import pairwise

AXES = (range(7), "abcd", (None, True, False), (0.5, 1.5))


def test_any_two_values_meet() -> None:
    rows = pairwise(*AXES)
    for first, second in combinations(range(len(AXES)), 2):
        met = {(row[first], row[second]) for row in rows}
        assert met == set(product(AXES[first], AXES[second]))


def test_a_covering_set_is_small_and_always_the_same() -> None:
    rows = pairwise(*AXES)
    assert rows == pairwise(*AXES)
    assert len(set(rows)) == len(rows) < 2 * 7 * 4  # the largest two axes alone take 7 * 4
    assert len(pairwise(range(3), "ab")) == 6  # two axes: all combinations


def test_pairs_are_covered_wherever_a_combination_is_admitted() -> None:
    def admitted(first: int, second: str, third: int) -> bool:
        return (first, second) != (0, "a") and not (second == "b" and third == 1)

    rows = pairwise(range(3), "abc", range(2), where=admitted)
    possible = [row for row in product(range(3), "abc", range(2)) if admitted(*row)]
    assert set(rows) <= set(possible)
    for first, second in combinations(range(3), 2):
        assert {(r[first], r[second]) for r in rows} == {(r[first], r[second]) for r in possible}

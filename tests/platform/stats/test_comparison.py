"""Comparisons of learners with rules, against quantiles of Student's t in closed form.

For two episodes Student's t is the Cauchy distribution, with quantiles tan(pi (p - 1/2)), and the standard
error is half the difference of the two values. For three the quantiles are (2p - 1) / sqrt(2p (1 - p)).
"""

import math

import pytest

from headway.events import Row
from headway.stats.comparison import (
    ComparisonRow,
    best_learner,
    best_rule,
    comparison_rows,
    difference,
    gaps,
    mean_return,
)

T_1 = math.tan(0.475 * math.pi)
"""Student's t of two values at 97.5%."""
T_2 = 0.95 / math.sqrt(2 * 0.975 * 0.025)
"""Student's t of three values at 97.5%."""


def episodes(*returns: float) -> list[Row]:
    return [{"return": value, "wait": value / 2} for value in returns]


def test_the_difference_of_one_seed_is_over_episodes() -> None:
    found = difference([[4.0, 9.0, 8.0]], [1.0, 2.0, 3.0])  # 3, 7 and 5: a standard deviation of 2
    half = T_2 * 2.0 / math.sqrt(3)
    assert (found.estimate, found.method) == (5.0, "t over episodes")
    assert (found.low, found.high) == pytest.approx((5.0 - half, 5.0 + half))
    with pytest.raises(ValueError, match="at least two episodes"):
        difference([[4.0]], [1.0])


def test_the_difference_of_two_seeds_is_over_seeds_and_episodes() -> None:
    found = difference([[4.0, 9.0], [6.0, 17.0]], [1.0, 2.0])  # 3, 7; 5, 15: by seed 5, 10; by episode 4, 11
    half = T_1 * math.hypot(5.0 / 2, 7.0 / 2)
    assert (found.estimate, found.method) == (7.5, "t over seeds and episodes")
    assert (found.low, found.high) == pytest.approx((7.5 - half, 7.5 + half))
    narrow = difference([[4.0, 9.0], [6.0, 17.0]], [1.0, 2.0], confidence=0.5)  # t is 1
    assert narrow.high - narrow.estimate == pytest.approx(math.hypot(2.5, 3.5))


def test_rows_are_learners_then_rules_by_return_for_each_metric() -> None:
    rules = {"slow": episodes(1.0, 3.0), "fast": episodes(4.0, 6.0)}
    learned = {"b": [episodes(9.0, 7.0)], "a": [episodes(0.0, 2.0), episodes(4.0, 6.0)]}
    rows = comparison_rows(rules, learned, ("wait", "return"), "fast")
    assert [(row.metric, row.controller, row.seeds) for row in rows] == [
        (metric, *controller)
        for metric in ("wait", "return")
        for controller in (("b", 1), ("a", 2), ("rule fast", None), ("rule slow", None))
    ]
    b, a, fast, slow = rows[4:]
    # b minus fast is 5 and 1; a minus fast has the means -4 and 0 by seed, -2 and -2 by episode.
    assert b[3:] == pytest.approx((8.0, 3.0, 3.0 - 2 * T_1, 3.0 + 2 * T_1, "t over episodes"))
    assert a[3:] == pytest.approx((3.0, -2.0, -2.0 - 2 * T_1, -2.0 + 2 * T_1, "t over seeds and episodes"))
    assert fast == ComparisonRow("return", "rule fast", None, 5.0)
    assert slow[3:] == (2.0, -3.0, -3.0, -3.0, "t over episodes")
    assert rows[0][3:] == pytest.approx((4.0, 1.5, 1.5 - T_1, 1.5 + T_1, "t over episodes"))


def test_one_episode_has_a_difference_without_interval_and_no_reference_has_none() -> None:
    rules, learned = {"hold": episodes(1.0)}, {"a": [episodes(4.0), episodes(8.0)]}
    first, *_ = comparison_rows(rules, learned, (), "hold")
    assert first == ComparisonRow("return", "a", 2, 6.0, 5.0)
    assert all(row.difference is None for row in comparison_rows(rules, learned, ("return", "wait"), None))
    # Without names only the return is compared.
    assert [row.difference for row in comparison_rows(rules, learned, (), "hold")] == [5.0, None, None, None]


@pytest.mark.parametrize("learners", [1, 2, 7])
def test_the_interval_of_the_best_of_n_learners_has_an_nth_of_the_error(learners: int) -> None:
    others = {f"other {number}": [episodes(0.0, 1.0)] for number in range(learners - 1)}
    row = best_learner({"hold": episodes(1.0, 1.0)}, {**others, "best": [episodes(20.0, 22.0)]}, "hold")
    t = math.tan(math.pi * (0.5 - 0.025 / learners))
    assert (row.controller, row.seeds, row.mean, row.difference) == ("best", 1, 21.0, 20.0)
    assert (row.low, row.high) == pytest.approx((20.0 - t, 20.0 + t))


def test_lookahead_is_the_best_rule_only_if_it_is_alone() -> None:
    rules = {"hold": episodes(1.0), "move": episodes(2.0), "lookahead:move": episodes(9.0)}
    assert best_rule(rules) == "move"
    assert best_rule({"lookahead:move": episodes(9.0)}) == "lookahead:move"
    assert best_rule({}) is None
    assert mean_return([episodes(1.0, 2.0), episodes(6.0)]) == 3.75  # of seeds' means


@pytest.mark.parametrize("sign", [1, -1])
def test_a_gap_is_paired_by_episode_and_learners_close_shares_of_it(sign: int) -> None:
    """Gains of 9 and 11 by the reference over `move`, the best other rule, at 20 on average."""
    values = {
        "hold": [0.0, 0.0],
        "move": [10.0, 30.0],
        "lookahead": [19.0, 41.0],
        "lookahead:hold": [1.0, 9.0],
    }
    rules = {rule: [sign * value for value in of_rule] for rule, of_rule in values.items()}
    first, second = gaps({"a": sign * 25.0, "b": sign * 18.0}, rules, sign)
    assert (first.best, first.reference, first.lead is not None) == ("move", "lookahead", True)
    # An interval that reaches 0 gives no shares: the half width is 12.7.
    assert first.lead is not None
    assert (first.lead.estimate, first.lead.high) == pytest.approx((10.0, 10.0 + T_1))
    assert (first.lead.low > 0, first.shares) == (False, {})
    assert (second.reference, second.shares) == ("lookahead:hold", {})
    rules["lookahead"] = [sign * 20.0, sign * 40.0]
    first, _ = gaps({"a": sign * 25.0, "b": sign * 18.0}, rules, sign)
    assert first.shares == pytest.approx({"a": 0.5, "b": -0.2})
    [single] = gaps({}, {"move": [1.0], "lookahead": [2.0]}, sign)
    assert (single.lead, single.shares) == (None, {})
    assert gaps({"a": 1.0}, {"move": [1.0]}) == gaps({"a": 1.0}, {"lookahead": [1.0]}) == []

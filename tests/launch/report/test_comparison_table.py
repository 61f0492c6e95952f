"""The comparison of learners and rules as a table for a page or a paper."""

import json

import pytest

from headway.events import Row
from headway.stats.comparison import ComparisonRow
from headway.stats.pairs import pair_rows
from headway_launch.report.comparison_table import comparison_table, records
from headway_launch.runner.comparison import Comparison


def test_differences_have_a_sign_and_zero_is_never_negative() -> None:
    rows = [
        ComparisonRow("return", "ippo", 3, -0.004, -0.004, -0.6, 0.6, "t over episodes"),
        ComparisonRow("return", "rule r", None, 0.0),
        ComparisonRow("length", "ippo", 3, 9.5, 2.5, 2.5, 2.5, "t over episodes"),
        ComparisonRow("length", "rule r", None, 7.0),
    ]
    comparison = Comparison("", "r", {"return": "return", "length": "length"}, rows)
    assert comparison_table(comparison).rows == [
        ["ippo", "3", "0.0", "+0.0 [-0.6, 0.6]", "9.500", "+2.500 [2.500, 2.500]"],
        ["rule r", "\N{EN DASH}", "0.0", "\N{EN DASH}", "7", "\N{EN DASH}"],
    ]


def test_equal_differences_do_not_add_digits() -> None:
    """Their interval is as wide as the rounding of their sum: -7.9 three times."""
    equal, apart = ([{"return": value} for value in values] for values in ([-7.9] * 3, [-8.0, -7.0, -6.0]))
    rules: dict[str, list[Row]] = {"none": [{"return": 0.0}] * 3, "equal": equal, "apart": apart}
    comparison = Comparison.of("", {}, rules, {}, reference="none")
    place = comparison.controllers.index("rule equal")
    assert comparison.rows[place].low != comparison.rows[place].high
    assert comparison_table(comparison).rows[place][2:] == ["-7.9", "-7.9 [-7.9, -7.9]"]


@pytest.mark.parametrize(("low", "shown"), [(0.2, "+8.2 [0.2, 16.2]"), (-0.04, "+8.20 [-0.04, 16.20]")])
def test_an_end_of_an_interval_is_not_rounded_to_0(low: float, shown: str) -> None:
    """[0.2, 16.2] as [0, 16] would leave open whether 0 is excluded."""
    rows = [
        ComparisonRow("return", "ippo", 3, 350.0, 8.2, low, 16.2, "t over episodes"),
        ComparisonRow("return", "rule r", None, 341.8),
    ]
    comparison = Comparison("", "r", {"return": "return"}, rows)
    assert comparison_table(comparison).rows[0][3] == shown


def test_a_record_of_a_pair_is_a_record_of_a_difference() -> None:
    """What is unknown is null, and JSON has no infinity."""
    rows = [ComparisonRow("return", name, 1, 2.0, 1.0, 0.0, 2.0, "t over episodes") for name in ("a", "b")]
    rows.append(ComparisonRow("return", "rule r", None, 1.0))
    single = {"a": [[2.0, 2.5]], "b": [[1.0, 2.0]]}
    several = {"a": [[2.0, 3.0], [2.5, 2.5]], "b": [[2.5, 2.0], [2.0, 3.0]]}
    for learned, needed in ((single, None), (several, ">1,000")):
        pairs = pair_rows("return", learned, [("a", "b")])
        listed = records(Comparison("", "r", {"return": "return"}, rows), pairs)
        json.dumps(listed, allow_nan=False)
        assert [record["reference"] for record in listed] == ["rule r", "rule r", None, "b"]
        assert listed[-1]["controller"] == "a"
        assert listed[-1]["difference"] == pairs[0].difference.estimate
        assert listed[-1]["seeds needed"] == needed
        assert set(map(tuple, listed)) == {tuple(listed[0])}

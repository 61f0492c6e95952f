"""The comparison of learners and rules as a table for a page or a paper."""

import json

from headway.events import Row
from headway_launch.report.comparison_table import (
    Comparison,
    ComparisonRow,
    comparison_rows,
    comparison_table,
)
from headway_launch.studies.learner_pairs import pair_rows


def test_differences_have_a_sign_and_zero_is_never_negative() -> None:
    rows = [
        ComparisonRow("return", "ippo", 3, -0.004, -0.004, -0.6, 0.6, "t over episodes"),
        ComparisonRow("return", "rule r", None, 0.0),
        ComparisonRow("length", "ippo", 3, 9.5, 2.5, 2.5, 2.5, "t over episodes"),
        ComparisonRow("length", "rule r", None, 7.0),
    ]
    comparison = Comparison("", "r", {"return": "return", "length": "length"}, ["ippo", "rule r"], rows)
    assert comparison_table(comparison).rows == [
        ["ippo", "3", "0.0", "+0.0 [-0.6, 0.6]", "9.500", "+2.500 [2.500, 2.500]"],
        ["rule r", "\N{EN DASH}", "0.0", "\N{EN DASH}", "7", "\N{EN DASH}"],
    ]
    assert str(comparison.rounded()[0][3]) == "0.0"


def test_equal_differences_do_not_add_digits() -> None:
    """Their interval is as wide as the rounding of their sum: -7.9 three times."""
    equal, apart = ([{"return": value} for value in values] for values in ([-7.9] * 3, [-8.0, -7.0, -6.0]))
    rules: dict[str, list[Row]] = {"none": [{"return": 0.0}] * 3, "equal": equal, "apart": apart}
    rows = comparison_rows(["return"], rules, {}, "none")
    assert rows[1].low != rows[1].high
    comparison = Comparison("", "none", {"return": "return"}, [row.controller for row in rows], rows)
    assert comparison_table(comparison).rows[1][2:] == ["-7.9", "-7.9 [-7.9, -7.9]"]


def test_an_end_of_an_interval_is_not_rounded_to_0() -> None:
    """[0.2, 16.2] as [0, 16] would leave open whether 0 is excluded."""
    rows = [
        ComparisonRow("return", "ippo", 3, 350.0, 8.2, 0.2, 16.2, "t over episodes"),
        ComparisonRow("return", "rule r", None, 341.8),
    ]
    comparison = Comparison("", "r", {"return": "return"}, ["ippo", "rule r"], rows)
    assert comparison_table(comparison).rows[0][3] == "+8.2 [0.2, 16.2]"


def test_a_record_of_a_pair_is_a_record_of_a_difference() -> None:
    """What is unknown is null, and JSON has no infinity."""
    rows = [ComparisonRow("return", name, 1, 2.0, 1.0, 0.0, 2.0, "t over episodes") for name in ("a", "b")]
    rows.append(ComparisonRow("return", "rule r", None, 1.0))
    single = {"a": [[2.0, 2.5]], "b": [[1.0, 2.0]]}
    several = {"a": [[2.0, 3.0], [2.5, 2.5]], "b": [[2.5, 2.0], [2.0, 3.0]]}
    for learned, needed in ((single, None), (several, ">1,000")):
        pairs = pair_rows("return", learned, [("a", "b")])
        names = ["a", "b", "rule r"]
        records = Comparison("", "r", {"return": "return"}, names, rows, pairs).records()
        json.dumps(records, allow_nan=False)
        assert [record["reference"] for record in records] == ["rule r", "rule r", None, "b"]
        assert records[-1]["controller"] == "a"
        assert records[-1]["difference"] == pairs[0].difference.estimate
        assert records[-1]["seeds needed"] == needed
        assert set(map(tuple, records)) == {tuple(records[0])}

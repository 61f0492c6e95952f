"""The comparison of learners and rules as a table for a page or a paper."""

from headway_launch.report.comparison_table import Comparison, ComparisonRow, comparison_table


def test_differences_have_a_sign_and_zero_is_never_negative() -> None:
    rows = [
        ComparisonRow("return", "ippo", 3, -0.04, -0.04, -0.6, 0.6, "t over episodes"),
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

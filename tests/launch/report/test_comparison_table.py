"""The comparison of learners and rules as a table for a page or a paper."""

import json

import numpy as np
import pytest

from headway.stats.pairs import LearnerDifference, holm
from headway_launch.report.comparison_table import (
    Comparison,
    ComparisonRow,
    comparison_table,
    pair_rows,
    pairs_table,
)


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


def test_pairs_are_one_family_of_hypotheses() -> None:
    draw = np.random.default_rng(0).normal
    learned = {name: draw(mean, 1.0, (4, 6)).tolist() for name, mean in (("a", 0), ("b", 1), ("c", 4))}
    asked = [("a", "b"), ("a", "c"), ("b", "c")]
    rows = pair_rows("return", learned, asked)
    alone = [LearnerDifference.of(learned[a], learned[b]) for a, b in asked]
    assert [(row.a, row.b) for row in rows] == asked
    assert [row.corrected_p for row in rows] == pytest.approx(holm([each.p_value for each in alone]))
    assert [row.seeds_needed for row in rows] == [each.seeds_needed(0.05 / 3) for each in alone]
    table = pairs_table(rows, "pairs", "Pairs")
    assert "p (Holm): corrected by Holm for 3 pairs." in table.caption
    assert "with 6 episodes" in table.caption


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
        assert records[-1]["difference"] == pairs[0].found.estimate
        assert records[-1]["seeds needed"] == needed
        assert set(map(tuple, records)) == {tuple(records[0])}

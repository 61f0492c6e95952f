"""Pairs of learners as one family of hypotheses."""

import numpy as np
import pytest

from headway.stats.pairs import LearnerDifference, holm, pair_rows
from headway_launch.studies.learner_pairs import pairs_note


def test_pairs_are_one_family_of_hypotheses() -> None:
    draw = np.random.default_rng(0).normal
    learned = {name: draw(mean, 1.0, (4, 6)).tolist() for name, mean in (("a", 0), ("b", 1), ("c", 4))}
    asked = [("a", "b"), ("a", "c"), ("b", "c")]
    rows = pair_rows("return", learned, asked)
    alone = [LearnerDifference.of(learned[a], learned[b]) for a, b in asked]
    assert [(row.a, row.b) for row in rows] == asked
    assert [row.corrected_p for row in rows] == pytest.approx(holm([each.p_value for each in alone]))
    assert [row.seeds_needed for row in rows] == [each.seeds_needed(0.05 / 3) for each in alone]
    assert pairs_note(rows).startswith("p (Holm): corrected by Holm for 3 pairs.")
    assert "with 6 episodes" in pairs_note(rows)

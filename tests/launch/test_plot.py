"""The rules in the pictures of `headway plot`."""

import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from headway_launch.commands.plot import _draw_rules, _near


@pytest.mark.parametrize(
    ("metric", "drawn"),
    [("evaluation_greedy/return", True), ("evaluation_sampled/return", True), ("training/return", False)],
)
def test_rules_stand_beside_what_was_played_on_their_days(metric: str, drawn: bool, tmp_path: Path) -> None:
    """Training is paid by what is learned from, whose reward may be another."""
    days = [{"episode_seed": 0, "return": 3.0}]
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "cell.rules.json").write_text(json.dumps({"optimal": days}))
    axes = Figure().add_subplot()
    axes.plot([0, 1], [2.0, 4.0])
    _draw_rules(axes, tmp_path, "study", metric, days=1)
    assert (len(axes.lines) == 2) is drawn


def test_a_rule_far_away_does_not_flatten_the_picture() -> None:
    rules = {"random": -1819.0, "always_move": 104.0, "even_headway": 240.0}
    assert _near(rules, 90.0, 250.0) == {"always_move", "even_headway"}
    assert _near(rules, -1800.0, 250.0) == set(rules)  # a curve that begins there
    # A flat curve hides no rule: what is near is judged with the nearest rule in the picture.
    assert _near({"random": -0.5, "optimal": 11.0}, 3.9, 4.1) == {"random", "optimal"}
    assert _near({"random": -0.5}, 4.0, 4.0) == {"random"}

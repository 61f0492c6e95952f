"""The rules in the pictures of `headway plot`, and the curves that they stand beside."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from headway.contracts.errors import HeadwayError
from headway.drawing import draw_rules, near_rules
from headway.store import RunLog, RunRecord, Selection, select
from headway.store.durable import write_text
from headway.store.folder import Process, create_run_folder, now, rules_file
from headway_launch.study import curves_of, rules_beside


@pytest.fixture
def runs(tmp_path: Path) -> Selection:
    run_id, directory = create_run_folder(tmp_path, "study", "cell", 0)
    record = RunRecord(run_id, "study", "bus", "ippo", 0, 1, now(), Process.current(), "FINISHED")
    replace(record).write(directory)
    write_text(directory / "config.yaml", "evaluation: {episodes: 2}")
    log = RunLog(directory)
    log.append("curve", [{"iteration": 0, "env_steps": 0, "training/return": 1.0}])
    log.commit(0)
    days = [{"episode_seed": day, "return": 3.0 + day} for day in range(9)]
    rules_file(tmp_path, "study", record.cell).write_text(json.dumps({"optimal": days}))
    return select(tmp_path, study="study")


@pytest.mark.parametrize("metric", ["evaluation_greedy/return", "evaluation_sampled/return"])
def test_rules_stand_beside_curves_of_evaluation_on_the_days_of_their_points(
    metric: str, runs: Selection
) -> None:
    assert rules_beside(runs, metric) == {"bus": {"optimal": 3.5}}


def test_rules_do_not_stand_beside_other_curves(runs: Selection) -> None:
    """Training is paid by what is learned from, whose reward may be another."""
    assert rules_beside(runs, "training/return") == {}
    assert rules_beside(runs, "evaluation_greedy/regret") == {}


def test_a_metric_that_a_run_has_not_is_one_line_with_the_nearest(runs: Selection) -> None:
    assert curves_of(runs, "training/return")["value"].tolist() == [1.0]
    with pytest.raises(HeadwayError, match=r"has no 'training/retrun'; did you mean training/return\?"):
        curves_of(runs, "training/retrun")


def test_a_rule_far_away_does_not_flatten_the_picture() -> None:
    rules = {"random": -1819.0, "always_move": 104.0, "even_headway": 240.0}
    assert near_rules(rules, 90.0, 250.0) == {"always_move", "even_headway"}
    assert near_rules(rules, -1800.0, 250.0) == set(rules)  # a curve that begins there
    # A flat curve hides no rule: what is near is judged with the nearest rule in the picture.
    assert near_rules({"random": -0.5, "optimal": 11.0}, 3.9, 4.1) == {"random", "optimal"}
    assert near_rules({"random": -0.5}, 4.0, 4.0) == {"random"}
    axes = Figure().add_subplot()
    axes.plot([0, 1], [90.0, 250.0])
    draw_rules(axes, rules)
    assert axes.get_ylim()[0] > 0
    assert "rule random (off, at -1,819)" in [line.get_label() for line in axes.lines]

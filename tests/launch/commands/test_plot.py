"""The rules in the pictures of `headway plot`, and the curves that they stand beside."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_lines import refused
from matplotlib.figure import Figure
from stored_runs import RESULTS, keep

from headway.contracts.errors import HeadwayError
from headway.stats import plots
from headway.stats.plots import colours, intervals, learning_curves, near_rules, outliers, plot_rules
from headway.store.query import RunSelection, select
from headway.store.run_folder import rules_file
from headway_launch.commands.main import run
from headway_launch.studies.runs import curves_of, rules_beside


def _keep_seed(
    root: Path, seed: int, metric: str, points: Mapping[int, float], study: str = "apart", algo: str = "a3c"
) -> None:
    curve = [{"iteration": step, "env_steps": step, metric: points[step]} for step in points]
    keep(root, study, seed, algorithm=algo, config=RESULTS["config"], logs={"curve": curve}, iterations=1)


@pytest.fixture
def runs(tmp_path: Path) -> RunSelection:
    _keep_seed(tmp_path, 0, "training/return", {0: 1.0}, "study", "ippo")
    [row] = select(tmp_path, study="study").rows
    days = [{"episode_seed": day, "return": 3.0 + day} for day in range(9)]
    rules_file(tmp_path, "study", row.cell).write_text(json.dumps({"optimal": days}))
    return select(tmp_path, study="study")


@pytest.mark.parametrize("metric", ["evaluation_greedy/return", "evaluation_sampled/return"])
def test_rules_stand_beside_evaluation_on_the_days_of_their_points(metric: str, runs: RunSelection) -> None:
    assert rules_beside(runs, metric) == {"bus": {"optimal": 3.5}}


def test_rules_do_not_stand_beside_other_curves(runs: RunSelection) -> None:
    """Training is paid by what is learned from, whose reward may be another."""
    assert rules_beside(runs, "training/return") == {}
    assert rules_beside(runs, "evaluation_greedy/regret") == {}


def test_a_metric_that_a_run_has_not_is_one_line_with_the_nearest(runs: RunSelection) -> None:
    assert curves_of(runs, "training/return")["value"].tolist() == [1.0]
    with pytest.raises(HeadwayError, match=r"has no 'training/retrun'; did you mean training/return\?"):
        curves_of(runs, "training/retrun")


def test_training_curves_whose_points_lie_at_different_steps_are_drawn(tmp_path: Path) -> None:
    """Asynchronous algorithms have such curves; points of evaluation are at the same steps in all runs."""
    apart: list[dict[int, float]] = [{0: 0.0, 2: 2.0, 4: 8.0}, {1: 3.0, 3: 5.0}]
    for seed, points in enumerate(apart):
        _keep_seed(tmp_path, seed, "training/return", points)
    curves = curves_of(select(tmp_path, study="apart"), "training/return")
    by_seed = {
        seed: dict(zip(of["env_steps"], of["value"], strict=True)) for seed, of in curves.groupby("seed")
    }
    assert by_seed == {0: {1: 1.0, 2: 2.0, 3: 5.0}, 1: {1: 3.0, 2: 4.0, 3: 5.0}}
    words = ["plot", "apart", "--store", str(tmp_path), "--output", str(tmp_path / "drawn.png")]
    assert run([*words, "--metric", "training/return"]) == 0
    assert (tmp_path / "drawn.png").exists()
    _keep_seed(tmp_path, 2, "training/return", {5: 1.0, 6: 1.0})
    line = refused(*words, "--metric", "training/return")
    assert "share no step with a value of 'training/return'\n" in line


def test_a_bare_name_is_a_metric_of_the_greedy_evaluation(tmp_path: Path) -> None:
    _keep_seed(tmp_path, 0, "evaluation_greedy/wait", {0: 2.0, 4: 1.0})
    words = ["plot", "apart", "--store", str(tmp_path), "--output", str(tmp_path / "drawn.svg")]
    assert run([*words, "--metric", "wait"]) == 0
    assert "greedy: wait" in (tmp_path / "drawn.svg").read_text()
    assert "did you mean evaluation_greedy/wait?" in refused(*words, "--metric", "wiat")
    absent = ("--metric", "wait", "--output", str(tmp_path / "absent" / "x.png"))
    assert "absent/x.png cannot be written" in refused(*words, *absent)


def test_evaluations_at_different_steps_are_not_put_together(tmp_path: Path) -> None:
    for seed, points in enumerate(({0: 0.0, 2: 2.0}, {1: 3.0, 3: 5.0})):
        _keep_seed(tmp_path, seed, "evaluation_greedy/return", points)
    with pytest.raises(HeadwayError, match="share no step with a value of 'evaluation_greedy/return'"):
        curves_of(select(tmp_path, study="apart"), "evaluation_greedy/return")


def test_a_rule_far_away_does_not_flatten_the_picture() -> None:
    rules = {"random": -1819.0, "always_move": 104.0, "even_headway": 240.0}
    assert near_rules(rules, 90.0, 250.0) == {"always_move", "even_headway"}
    assert near_rules(rules, -1800.0, 250.0) == set(rules)  # a curve that begins there
    # A flat curve hides no rule: what is near is judged with the nearest rule in the picture.
    assert near_rules({"random": -0.5, "optimal": 11.0}, 3.9, 4.1) == {"random", "optimal"}
    assert near_rules({"random": -0.5}, 4.0, 4.0) == {"random"}
    # The best rule is never off scale.
    assert near_rules({"poor": 0.0, "best": 90.0}, 1.0, 2.0) == {"poor", "best"}
    assert near_rules({"best": 0.0, "poor": 90.0}, 1.0, 2.0, sign=-1) == {"best"}
    axes = Figure().add_subplot()
    axes.plot([0, 1], [90.0, 250.0])
    plot_rules(axes, rules)
    assert axes.get_ylim()[0] > 0
    assert "rule random (off scale: -1,819)" in [line.get_label() for line in axes.lines]
    scores = pd.DataFrame({"iqm": [90.0, 250.0], "iqm_low": [80.0, 200.0], "iqm_high": [99.0, 290.0]})
    scores.index = pd.Index(["ippo", "mappo"])
    [upright] = intervals(scores, rules, "", colours(["ippo", "mappo"])).axes
    assert upright.get_xlim()[0] > 0
    legend = upright.get_legend()
    assert legend is not None
    styles = {
        text.get_text(): (line.get_color(), line.get_linestyle())
        for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)
    }
    assert styles == {
        str(line.get_label()): (line.get_color(), line.get_linestyle())
        for line in axes.lines
        if str(line.get_label()).startswith("rule ")
    }
    assert len(styles) == len(rules)


def test_of_a_study_the_cells_that_are_wanted_are_drawn_and_rules_can_be_left_out(
    runs: RunSelection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _keep_seed(tmp_path, 0, "evaluation_greedy/return", {0: 2.0}, "study", "mappo")
    drawn: list[tuple[list[str], object, str, int, object]] = []

    def keep(
        means: pd.DataFrame, rules: object, axis: str, styles: object, *, low: object, title: str, sign: int,
        rule_phases: object,
    ) -> Figure:  # fmt: skip
        assert rule_phases == {}
        drawn.append((sorted(means["controller"].unique()), rules, axis, sign, title))
        return Figure()

    monkeypatch.setattr(plots, "learning_curves", keep)
    words = ["plot", "study", "--store", str(tmp_path), "--output", str(tmp_path / "drawn.png")]
    assert run([*words, "--where", "algorithm=mappo", "--no-rules"]) == 0
    axis = "greedy: return"
    assert drawn == [(["mappo"], {}, axis, 1, "study: one seed")]
    assert run([*words, "--where", "algorithm=mappo", "--lower-is-better"]) == 0
    assert drawn[1][2:4] == (f"{axis} (lower is better)", -1)
    for condition, line in (
        ("algorithm=coma", "--where: no finished run of study matches"),
        ("mappo", "is not a condition"),
    ):
        assert line in refused(*words, "--where", condition)


def _curves(**by_controller: list[float]) -> pd.DataFrame:
    rows = [
        {"task": "t", "controller": name, "runs": 2, "env_steps": 10 * place, "mean": value}
        for name, values in by_controller.items()
        for place, value in enumerate(values)
    ]
    return pd.DataFrame(rows).assign(low=lambda frame: frame["mean"] * 9, high=lambda frame: frame["mean"])


def test_a_cell_that_diverged_does_not_flatten_the_others() -> None:
    curves = _curves(ippo=[1.0, 9.0], ddpg=[1.0, -98_439.0], mappo=[1.0, 12.0])
    [axes] = learning_curves(curves, {"t": {"optimal": 20.0}}, "", colours(["ippo", "ddpg", "mappo"])).axes
    low, high = axes.get_ylim()
    assert 20 < high < 200
    assert -10 < low <= 1
    labels = [line.get_label() for line in axes.lines]
    assert labels == [
        "ippo (2 seeds)", "mappo (2 seeds)", "rule optimal", "ddpg (2 seeds) (off scale: -98,440)",
    ]  # fmt: skip
    assert [line.get_marker() for line in axes.lines[:2]] == ["o", "o"]  # two points are seen as two
    scores = pd.DataFrame(
        {"iqm": [5.0, -98_439.0, 7.0], "iqm_low": [4.0, -2e5, 6.0], "iqm_high": [6.0, -5e4, 8.0]},
        index=["ippo", "ddpg", "mappo"],
    )
    [axes] = intervals(scores, {}, "", colours(["ippo", "ddpg", "mappo"])).axes
    assert axes.get_xlim()[0] > 0
    assert any("off scale" in tick.get_text() for tick in axes.get_yticklabels())


def test_wide_intervals_do_not_flatten_the_curves() -> None:
    """With few seeds the bands may be hundreds of times as wide as the curves' range."""
    wide = _curves(ippo=[0.0, 9.0], mappo=[0.0, 10.0]).assign(low=-900.0, high=900.0, runs=3)
    styles = colours(["ippo", "mappo"])
    [axes] = learning_curves(wide, {}, "", styles).axes
    low, high = axes.get_ylim()
    assert -7 < low <= -5
    assert 15 <= high < 17
    [axes] = learning_curves(wide, {"t": {"optimal": 40.0}}, "", styles).axes
    assert 40 < axes.get_ylim()[1] < 45  # a rule that is near is seen
    [axes] = learning_curves(wide, {"t": {"optimal": 12.0, "random": -4000.0}}, "", styles).axes
    low, high = axes.get_ylim()
    assert -8 < low <= -5  # and one that is far is not, however wide the intervals
    assert 15 <= high < 17
    narrow = wide.assign(low=-1.0, high=11.0)
    [axes] = learning_curves(narrow, {}, "", styles).axes
    assert -2 < axes.get_ylim()[0] < -1  # and an axis grows no more than it has to


def test_cells_that_lie_far_from_each_other_are_all_drawn() -> None:
    """Each agrees with itself, and no two with each other: none is the one that diverged."""
    means = (-28.0, 1.6, 17.0, 36.0, 49.0, 67.0)
    assert outliers({str(mean): np.array([mean - 1, mean + 1]) for mean in means}) == {}
    assert outliers({str(mean): np.array([mean - 1, mean + 1]) for mean in (*means, -9000.0)}) == {
        "-9000.0": -9001.0
    }


def test_of_two_cells_or_of_wide_ones_none_is_off() -> None:
    near, away, third = np.array([0.0, 1.0]), np.array([0.0, -900.0]), np.array([-800.0, 1.0])
    assert outliers({"a": near, "b": away}) == {}
    assert outliers({"a": third, "b": away, "c": third}) == {}
    assert outliers({"a": near, "b": -away, "c": near}) == {}  # far better
    assert outliers({"a": near, "b": -away, "c": near}, sign=-1) == {"b": 900.0}
    assert outliers({"a": near, "b": away, "c": near}, sign=-1) == {}
    assert outliers({"a": near, "b": away, "c": near, "d": np.array([np.nan])}) == {"b": -900.0}


def test_thousands_are_separated_on_the_vertical_axis() -> None:
    [axes] = learning_curves(_curves(ippo=[1000.0, 98_000.0]), {}, "", colours(["ippo"])).axes
    assert "60,000" in {axes.yaxis.get_major_formatter()(value) for value in (60_000.0, 0.25)}
    assert axes.yaxis.get_major_formatter()(0.25) == "0.25"

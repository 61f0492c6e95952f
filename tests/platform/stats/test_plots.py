"""Plots of many cells are readable."""

import io
import math
from itertools import combinations, pairwise

import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from headway.stats.plots import (
    colours,
    footprint,
    intervals,
    learning_curves,
    performance_profiles,
    plot_rules,
    reward_against_cost,
    reward_components,
    rule_styles,
)

FOOTPRINT = ["kg_co2", "kwh", "cpu_kwh", "gpu_kwh", "ram_kwh", "cpu_seconds"]
FOOTPRINT += ["kg_co2_std", "kwh_std", "cpu_seconds_std"]
LONG = "mappo, algo.model.hidden [128, 128, 128], algo.gae_lambda 0.95, 6 settings more, cell {}"


def _assert_readable(figure: Figure) -> None:
    """Assert that all text is inside the figure, and that matplotlib warned of no collapsed layout."""
    figure.savefig(io.BytesIO())
    for axes in figure.axes:
        assert axes.bbox.width > 0.2 * figure.bbox.width
        drawn = axes.get_tightbbox()
        assert drawn is not None
        assert drawn.x0 >= 0
        assert drawn.y0 >= 0
        assert drawn.x1 <= figure.bbox.width
        assert drawn.y1 <= figure.bbox.height
        legend = axes.get_legend()
        assert legend is None or legend.get_window_extent().x0 >= axes.bbox.x1
        steps = [tick.get_window_extent() for tick in axes.get_xticklabels() if tick.get_text()]
        assert all(left.x1 <= right.x0 for left, right in pairwise(steps))
        beside = [tick.get_window_extent() for tick in axes.get_yticklabels()]
        beside.sort(key=lambda box: box.y0)
        assert all(low.y1 <= high.y0 for low, high in pairwise(beside))
        labels = sorted((Text.get_window_extent(text) for text in axes.texts), key=lambda box: box.y0)
        assert all(low.y1 <= high.y0 for low, high in pairwise(labels))
        assert all(axes.bbox.x1 < box.x0 and box.x1 <= figure.bbox.width for box in labels)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "kind",
    [
        "cost",
        *(
            pytest.param(kind, marks=pytest.mark.slow)
            for kind in ("curves", "intervals", "profiles", "footprint", "components")
        ),
    ],
)
def test_plots_of_twelve_cells_with_long_names_are_readable(kind: str) -> None:
    names = [LONG.format(place) for place in range(12)]
    styles, rules = colours(names), {f"rule_{place}": float(place) for place in range(9)}
    if kind == "curves":
        rows = [
            {"task": task, "controller": name, "runs": 10, "env_steps": steps, "mean": steps * place}
            for task in ("t", "another")
            for place, name in enumerate(names)
            for steps in (0, 400_000)
        ]
        means = pd.DataFrame(rows).assign(low=0.0, high=1.0)
        figure = learning_curves(means, {"t": rules}, "return", styles, title="study: mean over seeds")
    elif kind == "intervals":
        scores = pd.DataFrame({"iqm": 1.0, "iqm_low": 0.0, "iqm_high": 2.0}, index=names)
        figure = intervals(scores, rules, "IQM of final reward", styles)
    elif kind == "profiles":
        rows = [
            {"controller": name, "threshold": x, "share": 0.5, "low": 0.4, "high": 0.6}
            for name in names
            for x in (0.0, 1.0)
        ]
        figure = performance_profiles(pd.DataFrame(rows), "final reward", styles)
    elif kind == "footprint":
        units = {"kg_co2": ("mg", 1e6), "kwh": ("mWh", 1e6)}
        figure = footprint(pd.DataFrame(1e-6, index=names, columns=FOOTPRINT), units)
    elif kind == "cost":
        runs = pd.DataFrame({"task": "t", "controller": names, "final_reward": 1.0, "kwh": range(12)})
        figure = reward_against_cost(runs, "kwh", 1.0, ("kWh a run", "final reward"), styles)
    else:
        parts = pd.DataFrame({f"part_{part}": (-1.0) ** part for part in range(8)}, index=names)
        figure = reward_components(parts)
    _assert_readable(figure)


@pytest.mark.parametrize(("costs", "least"), [((2.70, 2.73), 0.27), ((1.0, 3.0), 2.0), ((0.0, 0.0), 0.0)])
def test_equal_costs_do_not_fill_the_axis(costs: tuple[float, float], least: float) -> None:
    runs = pd.DataFrame({"task": "t", "controller": ["a", "b"], "final_reward": 1.0, "kwh": costs})
    [axes] = reward_against_cost(runs, "kwh", 1.0, ("kWh", "reward"), colours(["a", "b"])).axes
    low, high = axes.get_xlim()
    assert high - low >= least
    assert low <= min(costs) <= max(costs) <= high


def test_fifty_lines_have_styles_of_their_own() -> None:
    assert len({str(style) for style in colours([str(name) for name in range(50)]).values()}) == 50


def _curve(seeds: int) -> Figure:
    points = {"env_steps": [0, 10], "mean": [0.0, 4.0], "low": [-1.0, 3.0], "high": [1.0, 5.0]}
    means = pd.DataFrame({"task": "t", "controller": "mappo", "runs": seeds, **points})
    rules = {"t": {"worse": 1.0, "better": 5.0, "hopeless": -900.0}}
    return learning_curves(means, rules, "return", colours(["mappo"]))


def test_lines_are_labelled_from_the_highest_to_those_off_scale() -> None:
    texts = _curve(3).axes[0].texts
    names = ["rule better", "mappo (3 seeds)", "rule worse", "rule hopeless (off scale: -900)"]
    assert [text.get_text() for text in sorted(texts, key=lambda text: -text.get_position()[1])] == names


def test_no_two_rules_have_the_same_pattern_and_each_has_its_own_in_all_pictures() -> None:
    names = [f"rule_{place}" for place in range(25)]
    patterns = [style["linestyle"][1] for style in rule_styles(names).values()]
    turned = [
        {marks[2 * turn :] + marks[: 2 * turn] for turn in range(len(marks) // 2)} for marks in patterns
    ]
    assert all(one.isdisjoint(other) for one, other in combinations(turned, 2))
    styles = {**colours(["a"]), **rule_styles(["last", "first", "middle"])}
    shown = []
    for values in ({"first": 3.0, "middle": 2.0, "last": 1.0}, {"last": 5.0, "first": 4.0}):
        axes = Figure().add_subplot()
        plot_rules(axes, values, styles=styles)
        shown.append({str(line.get_label()): line._dash_pattern for line in axes.lines})
    assert list(shown[0]) == ["rule last", "rule first", "rule middle"]
    assert list(shown[1]) == ["rule last", "rule first"]
    assert all(shown[0][name] == pattern for name, pattern in shown[1].items())


def test_intervals_that_overlap_much_are_outlined_and_cut_ones_are_marked() -> None:
    points = [(name, steps, steps / 100) for name in "ab" for steps in (0, 50, 100)]
    means = pd.DataFrame(points, columns=["controller", "env_steps", "mean"]).assign(runs=3)
    panels = []
    for half in (0.1, 0.6, 9.0):
        own = means.assign(low=means["mean"] - half, high=means["mean"] + half)
        panels += learning_curves(own, {}, "return", colours(["a", "b"])).axes
    assert [len(panel.collections) for panel in panels] == [2, 2, 0]
    assert [len(panel.lines) for panel in panels] == [2, 2, 6]
    marks = [panel.get_title("right") for panel in panels]
    assert marks == ["", *["some intervals continue beyond the axis"] * 2]


def test_two_seeds_have_no_band() -> None:
    assert [len(_curve(seeds).axes[0].collections) for seeds in (2, 3)] == [0, 1]


def test_a_footprint_without_co2_has_no_panel_for_it() -> None:
    energy = pd.DataFrame(1e-6, index=["a", "b"], columns=FOOTPRINT)
    unknown = energy.assign(kg_co2=math.nan, kg_co2_std=math.nan)
    units = {"kwh": ("mWh", 1e6)}
    labels = ["(a) mWh per run", "(b) CPU s per run"]
    assert [axes.get_xlabel() for axes in footprint(unknown, units).axes] == labels
    three = footprint(energy, {**units, "kg_co2": ("mg", 1e6)})
    labels = ["(a) mg CO2eq per run", "(b) mWh per run", "(c) CPU s per run"]
    assert [axes.get_xlabel() for axes in three.axes] == labels


def test_components_that_are_always_0_have_no_panel() -> None:
    parts = pd.DataFrame(
        {"speed": [1.0, 2.0], "lanes": [0.0, -2e-17], "crash": [math.nan, -1.0]}, index=["a", "b"]
    )
    assert [axes.get_xlabel() for axes in reward_components(parts).axes] == ["speed", "crash"]
    assert [axes.get_xlabel() for axes in reward_components(parts[["lanes"]]).axes] == ["lanes"]


def test_stages_are_vertical_lines_on_their_task() -> None:
    points = [(task, "mappo", steps, 1.0) for task in ("a", "b") for steps in (0, 50, 100)]
    means = pd.DataFrame(points, columns=["task", "controller", "env_steps", "mean"])
    means = means.assign(low=0.5, high=1.5, runs=4)
    figure = learning_curves(means, {}, "return", colours(["mappo"]), stage_ends={"b": [30, 60]})
    upright = [
        [line.get_xdata()[0] for line in axes.lines if len(set(line.get_xdata())) == 1]
        for axes in figure.axes
    ]
    assert upright == [[], [30, 60]]


@pytest.mark.parametrize("steps", [45, 55])
def test_long_names_of_a_rule_s_phase_stay_in_the_panel(steps: int) -> None:
    names = [
        "ippo",
        "mappo",
        "mappo, env_steps=15000, start.rule=even_headway, start.env_steps=6000, without x",
    ]
    points = [(name, at, 1.0) for name in names for at in (0, 50, 100)]
    means = pd.DataFrame(points, columns=["controller", "env_steps", "mean"])
    means = means.assign(low=0.5, high=1.5, runs=4)
    phases = {"": {names[1]: ("hold", steps), names[2]: ("even_headway", steps)}}
    figure = learning_curves(means, {}, "return", colours(names), rule_phases=phases)
    figure.draw_without_rendering()
    [axes] = figure.axes
    panel = axes.get_window_extent()
    texts = [text for text in axes.texts if text.get_text().startswith("rule ")]
    boxes = sorted((text.get_window_extent() for text in texts), key=lambda box: box.y0)
    assert len(boxes) == 2
    assert all(panel.x0 <= box.x0 and box.x1 <= panel.x1 for box in boxes)
    assert boxes[0].y1 <= boxes[1].y0


@pytest.mark.parametrize("sign", [1, -1])
def test_the_steps_in_which_a_rule_acts_are_shaded_and_named(sign: int) -> None:
    names = ["ippo", "mappo", "maa2c"]
    points = [(task, name, steps, 1.0) for task in ("a", "b") for name in names for steps in (0, 50, 100)]
    means = pd.DataFrame(points, columns=["task", "controller", "env_steps", "mean"])
    means = means.assign(low=0.5, high=1.5, runs=4)
    phases = {
        "a": dict.fromkeys(names, ("hold", 20)),
        "b": {"ippo": ("hold", 20), "mappo": ("hold", 20), "maa2c": ("wait", 50)},
    }
    figure = learning_curves(means, {}, "return", colours(names), sign=sign, rule_phases=phases)
    first, second = (
        [text.get_text() for text in axes.texts if text.get_text().startswith("rule ")]
        for axes in figure.axes
    )
    assert first == ["rule hold acts until here"]
    assert second == ["rule hold acts until here (2 curves)", "rule wait acts until here (maa2c)"]
    spans = [[patch.get_extents().width for patch in axes.patches] for axes in figure.axes]
    assert [len(widths) for widths in spans] == [1, 2]
    assert spans[1][1] == pytest.approx(2.5 * spans[1][0])

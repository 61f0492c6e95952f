"""The section beside the crossing's published table."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sections import section_of, tables, words

from headway_launch.report.parts import Section
from headway_launch.report.published.crossing import crossing_figures, crossing_section
from headway_launch.report.study_data import StudyData

PAPER = "experiment=intersection_paper_ippo"
METRICS = {"paper_return": 8e5, "outflow_vph": 600.0, "collisions": 0.5, "speed": 6.0}
HUMAN = {"outflow_vph": 500.0, "collisions": 0.5}
Keep = Callable[..., Path]


def section(root: Path) -> Section:
    return section_of(root, crossing_section)


def test_three_are_published() -> None:
    published = crossing_figures()
    assert list(published.index) == ["ippo", "a3c", "ddpg"]
    assert published.loc["ippo", "outflow_vph"] == 323
    assert np.isnan(published.loc["ddpg", "vehicles"])


def test_the_paper_s_row_of_what_was_trained_stands_above_ours(keep_run: Keep, root: Path) -> None:
    for seed in range(2):
        more = {**METRICS, "outflow_vph": 600.0 + 20 * seed}
        keep_run((PAPER,), seed, 10.0, rules={"human": 1.0}, rule_metrics=HUMAN, **more)
    found = section(root)
    shown = tables(found)["crossing"]
    assert [row[0].split(",")[0] for row in shown.rows] == ["published: PPO", "ippo", "rule human"]
    outflow = shown.headings.index("outflow, veh/h")
    assert [row[outflow] for row in shown.rows] == ["323", "610 ± 14", "500"]
    assert shown.emphasised == {2}
    [row] = tables(found)["against_humans"].rows
    assert row[1] == "2"
    assert row[2].startswith("+110")
    assert row[-1] == "no claim (outflow not told apart, collisions not told apart)"  # two seeds: t is wide
    assert "not the paper's" not in words(found)


@pytest.mark.parametrize(
    ("outflow", "collisions", "reading"),
    [(600.0, 0.0, "more leave, fewer crash"), (400.0, 2.0, "fewer leave, more crash")],
)
def test_ten_seeds_are_set_against_human_drivers(
    keep_run: Keep, root: Path, outflow: float, collisions: float, reading: str
) -> None:
    for seed in range(10):
        more = {**METRICS, "outflow_vph": outflow + seed, "collisions": collisions}
        overrides = ("experiment=intersection_ippo",)
        keep_run(overrides, seed, 10.0, rules={"human": 1.0}, rule_metrics=HUMAN, **more)
    found = section(root)
    assert tables(found)["against_humans"].rows[0][-1] == reading
    assert "compare those rows with the rules, not with the paper" in words(found)


def test_other_days_than_the_humans_are_not_compared(keep_run: Keep, root: Path) -> None:
    for seed, root_of_days in enumerate((1, 2)):
        overrides = (PAPER, f"evaluation.seed={root_of_days}")
        keep_run(overrides, seed, 10.0, rules={"human": 1.0}, rule_metrics=HUMAN, **METRICS)
    [row] = tables(section(root))["against_humans"].rows
    assert set(row[2:]) == {"\N{EN DASH}"}


def test_without_human_drivers_there_is_no_baseline(keep_run: Keep, root: Path) -> None:
    keep_run((PAPER,), 0, 10.0, **METRICS)
    assert "there is no baseline of human drivers" in words(section(root))


def test_other_environments_have_no_such_section(keep_run: Keep, root: Path) -> None:
    keep_run(("experiment=toy_tracking",), 0, 10.0)
    assert crossing_section(StudyData(root, "study")) is None

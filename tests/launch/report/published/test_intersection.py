"""Comparison of a study with the published intersection results."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sections import section_of, tables, words

from headway_launch.report.elements import Section
from headway_launch.report.published.episode_metrics import published_values
from headway_launch.report.published.intersection import intersection_section

PAPER = "experiment=intersection_paper_ippo"
METRICS = {"paper_return": 8e5, "outflow_vph": 600.0, "collisions": 0.5, "speed": 6.0}
HUMAN = {"outflow_vph": 500.0, "collisions": 0.5}
Keep = Callable[..., Path]


def section(root: Path) -> Section:
    return section_of(root, intersection_section)


def test_three_algorithms_have_published_values() -> None:
    published = published_values("intersection")
    assert list(published.index) == ["ippo", "a3c", "ddpg"]
    assert published.loc["ippo", "outflow_vph"] == 323
    assert np.isnan(published.loc["ddpg", "vehicles"])


def test_published_rows_of_trained_algorithms_stand_above_ours(keep_run: Keep, root: Path) -> None:
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
    assert (
        row[-1] == "no claim (outflow: no difference shown, collisions: no difference shown)"
    )  # two seeds: t is wide
    assert "differ from the paper's" not in words(found)


@pytest.mark.parametrize(
    ("outflow", "collisions", "reading"),
    [(600.0, 0.0, "more outflow, fewer collisions"), (400.0, 2.0, "less outflow, more collisions")],
)
def test_ten_seeds_are_compared_with_human_drivers(
    keep_run: Keep, root: Path, outflow: float, collisions: float, reading: str
) -> None:
    for seed in range(10):
        more = {**METRICS, "outflow_vph": outflow + seed, "collisions": collisions}
        overrides = ("experiment=intersection_ippo",)
        keep_run(overrides, seed, 10.0, rules={"human": 1.0}, rule_metrics=HUMAN, **more)
    found = section(root)
    assert tables(found)["against_humans"].rows[0][-1] == reading
    assert "compare those rows with the rules, not with the paper" in words(found)


def test_episodes_other_than_the_human_drivers_are_not_compared(keep_run: Keep, root: Path) -> None:
    for seed, root_of_days in enumerate((1, 2)):
        overrides = (PAPER, f"evaluation.seed={root_of_days}")
        keep_run(overrides, seed, 10.0, rules={"human": 1.0}, rule_metrics=HUMAN, **METRICS)
    [row] = tables(section(root))["against_humans"].rows
    assert set(row[2:]) == {"\N{EN DASH}"}


def test_without_human_drivers_there_is_no_baseline(keep_run: Keep, root: Path) -> None:
    keep_run((PAPER,), 0, 10.0, **METRICS)
    assert "There is no baseline of human drivers" in words(section(root))

"""Results by the value of a swept setting of the environment."""

from collections.abc import Callable
from pathlib import Path

import pytest
from sections import section_of, tables, words

from headway_launch.report.elements import Picture, Section
from headway_launch.report.sections.learning import across_environments
from headway_launch.report.sections.setting import setting_section
from headway_launch.report.study_data import StudyData

Keep = Callable[..., Path]


def keep_swept(keep_run: Keep, key: str, values: tuple[float, ...], *more: str, above: float = 0.0) -> None:
    """Store three seeds per value, whose returns are twice the value plus the seed; rules return 1 and 3."""
    for value in values:
        for seed in range(3):
            overrides = ("experiment=toy_tracking", f"env.args.{key}={value}", *more)
            keep_run(overrides, seed, above + 2 * value + seed, rules={"random": 1.0, "optimal": 3.0})


def lines_of(section: Section) -> list[dict[object, list[list[float]]]]:
    """Return the points of each line, by its label, of each panel of the section's picture."""
    [picture] = [part for part in section.body if isinstance(part, Picture)]
    return [
        {line.get_label(): line.get_xydata().tolist() for line in axes.lines} for axes in picture.figure.axes
    ]


def test_rows_have_the_mean_of_each_value_and_the_difference_from_its_best_rule(
    keep_run: Keep, root: Path
) -> None:
    keep_swept(keep_run, "agents", (4, 2, 1))
    table = tables(section_of(root, setting_section))["by_setting"]
    assert table.headings == ["agents", "ippo", "ippo minus best rule [95%]", "rule optimal", "rule random"]
    # Seeds 0 to 2 add 1 on average, episodes 0 to 3 add 1.5. Seeds differ by 1: Student's t with two degrees
    # of freedom is 4.303, so that the interval is 4.303 / sqrt(3) = 2.5 to either side.
    assert table.rows == [
        ["1", "4.500", "+0.0 [-2.5, 2.5]", "4.500", "2.500"],
        ["2", "6.500", "+2.0 [-0.5, 4.5]", "4.500", "2.500"],
        ["4", "10.50", "+6.0 [3.5, 8.5]", "4.500", "2.500"],
    ]
    of_learner = table.exact.set_index("controller").loc["ippo"]
    assert (of_learner["high"] - of_learner["mean"]).tolist() == pytest.approx([2.484] * 3, abs=1e-3)


def test_other_settings_that_differ_get_tables_and_panels_of_their_own(keep_run: Keep, root: Path) -> None:
    for above, noise in ((0.0, 0.01), (100.0, 0.05)):
        keep_swept(keep_run, "agents", (1, 2, 3), f"env.args.noise={noise}", above=above)
    section = section_of(root, setting_section)
    captions = [table.caption.partition(". ")[0] for table in tables(section).values()]
    assert [caption.partition("agents ")[2] for caption in captions] == ["(noise=0.01)", "(noise=0.05)"]
    assert [[row[1] for row in table.rows] for table in tables(section).values()] == [
        ["4.500", "6.500", "8.500"],
        ["104.5", "106.5", "108.5"],
    ]
    panels = lines_of(section)
    assert [panel["ippo (3 seeds)"] for panel in panels] == [
        [[1, 4.5], [2, 6.5], [3, 8.5]],
        [[1, 104.5], [2, 106.5], [3, 108.5]],
    ]
    assert [panel["rule optimal"] for panel in panels] == [[[1, 4.5], [2, 4.5], [3, 4.5]]] * 2


def test_wrappers_and_environments_are_settings_too(keep_run: Keep, root: Path) -> None:
    keep_swept(keep_run, "agents", (1, 2, 3))
    keep_swept(keep_run, "agents", (1, 2, 3), "env.wrappers=[{name: frame_stack_v1}]", above=10.0)
    for value in (1, 2, 3):
        keep_run(("experiment=toy_trivial", f"env.args.agents={value}"), 0, 20.0)
    found = tables(section_of(root, setting_section))
    assert [[row[1] for row in table.rows] for table in found.values()] == [
        ["4.500", "6.500", "8.500"],
        ["14.50", "16.50", "18.50"],
        ["21.50", "21.50", "21.50"],
    ]
    groups = [table.caption.partition("agents (")[2].partition(")")[0] for table in found.values()]
    assert [group.partition(",")[0] for group in groups] == ["tracking", "tracking", "trivial"]
    assert "frame_stack_v1" in groups[1]
    assert groups[2] == "trivial"  # only its own arguments could differ


def test_each_swept_setting_of_several_environments_is_shown(keep_run: Keep, root: Path) -> None:
    keep_swept(keep_run, "agents", (1, 2, 3))
    for density in (1, 2, 3):
        keep_run(("env=merge", "algo=ippo", "preset=none", f"env.args.density={density}"), 0, 5.0)
    section = section_of(root, setting_section)
    assert section.title == "Results by env.args.agents, env.args.density"
    found = tables(section)
    assert {name: [row[1] for row in table.rows] for name, table in found.items()} == {
        "by_setting_1": ["4.500", "6.500", "8.500"],
        "by_setting_2": ["6.500", "6.500", "6.500"],
    }


def test_values_of_a_setting_are_not_ranked_as_independent_environments(keep_run: Keep, root: Path) -> None:
    keep_swept(keep_run, "agents", (1, 2, 3))
    keep_swept(keep_run, "agents", (1, 2, 3), "algo=ia2c", above=1.0)
    across = section_of(root, across_environments)
    assert "ranks" not in tables(across)
    assert "values of env.args.agents are not independent" in words(across)


def test_a_distant_rule_is_listed_and_few_seeds_have_no_band(keep_run: Keep, root: Path) -> None:
    for value in (1, 2, 3):
        for seed in range(value):
            overrides = ("experiment=toy_tracking", f"env.args.agents={value}")
            keep_run(overrides, seed, 2 * value + seed, rules={"random": -1e5, "optimal": 20.0})
    section = section_of(root, setting_section)
    [picture] = [part for part in section.body if isinstance(part, Picture)]
    [axes] = picture.figure.axes
    low, high = axes.get_ylim()
    assert -20 < low < 3.5 < 21.5 < high  # the near rule is shown
    [panel] = lines_of(section)
    assert panel["ippo (1 to 3 seeds)"] == [[1, 3.5], [2, 6.0], [3, 8.5]]
    assert panel["rule random (off scale: -100,000)"] == []
    [band] = axes.collections
    assert {x for x, _ in band.get_paths()[0].vertices} == {3}


def test_without_rules_there_are_no_differences(keep_run: Keep, root: Path) -> None:
    for value in (1, 2, 3):
        keep_run(("experiment=toy_tracking", f"env.args.agents={value}"), 0, 2.0 * value)
    table = tables(section_of(root, setting_section))["by_setting"]
    assert table.headings == ["agents", "ippo"]
    assert table.rows == [["1", "3.500"], ["2", "5.500"], ["3", "7.500"]]
    assert "rule" not in table.caption


def test_a_group_without_last_evaluations_is_left_out(keep_run: Keep, root: Path) -> None:
    keep_swept(keep_run, "agents", (1, 2, 3), "env.args.noise=0.01")
    for value in (1, 2, 3):
        overrides = ("experiment=toy_tracking", f"env.args.agents={value}", "env.args.noise=0.05")
        folder = keep_run(overrides, 0, 2.0, rules={"random": 1.0, "optimal": 3.0})
        for log in folder.glob("evaluation-*.parquet"):
            log.unlink()
    section = section_of(root, setting_section)
    [table] = tables(section).values()
    assert [row[1] for row in table.rows] == ["4.500", "6.500", "8.500"]
    assert len(lines_of(section)) == 1


def test_only_numbers_of_equal_other_settings_are_a_sweep(keep_run: Keep, root: Path) -> None:
    keep_swept(keep_run, "agents", (1, 2), "env.args.noise=0.01")
    keep_swept(keep_run, "agents", (3,), "env.args.noise=0.05")
    assert setting_section(StudyData(root, "study")) is None


def test_a_value_that_is_no_number_is_left_out(keep_run: Keep, root: Path) -> None:
    for cavs in ("null", "2", "1", "3"):
        keep_run(("env=merge", "algo=ippo", "preset=none", f"env.args.cavs={cavs}"), 0, 5.0)
    table = tables(section_of(root, setting_section))["by_setting"]
    assert [row[0] for row in table.rows] == ["1", "2", "3"]

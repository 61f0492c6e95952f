"""Comparison of a study with the published merging study."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from sections import section_of, tables, words

from headway_launch.report.elements import Section
from headway_launch.report.published.bus_published import bus_published_section
from headway_launch.report.published.intersection import intersection_section
from headway_launch.report.published.merge import merge_section
from headway_launch.report.study_data import StudyData

STUDY = "experiment=merge_study"
Keep = Callable[..., Path]


def section(root: Path) -> Section:
    return section_of(root, merge_section)


def train(keep: Keep, env: str, rewards: list[float], *overrides: str, crash_rate: float = 0.1) -> None:
    for seed, reward in enumerate(rewards):
        metrics = {"reward": reward, "crash_rate": crash_rate, "merge_rate": 0.9, "mean_speed_ms": 25.0}
        rules = {"idm_mobil": 49.0, "random": -30.0}
        keep((STUDY, f"env={env}", *overrides), seed, reward, rules=rules, **metrics)


def test_published_ranges_stand_beside_rewards_crashes_and_rules(keep_run: Keep, root: Path) -> None:
    train(keep_run, "merge", [50.0, 54.0], "algo=madqn")
    train(keep_run, "merge", [60.0], "algo=ippo")
    shown = tables(section(root))["merging"]
    rows = {row[1]: row for row in shown.rows}
    assert rows["madqn"][2:7] == ["2", "-100 to 50", "52.0 ± 2.8", "0.100 ± 0.000", "0.900 ± 0.000"]
    assert rows["madqn"][-1] == "\N{EN DASH}"  # interventions were not logged
    assert rows["ippo"][3] == "\N{EN DASH}"  # not published
    assert [row[1] for row in shown.rows][-2:] == ["rule idm_mobil", "rule random"]
    assert shown.emphasised == {2, 3}
    assert "`merge` and on `merge_two_lane`" in words(section(root))


def test_change_with_a_second_lane_is_welch_s_difference(keep_run: Keep, root: Path) -> None:
    one = [50.0 + each for each in range(10)]
    two = [40.0 + each for each in range(10)]
    train(keep_run, "merge", one, "algo=mappo")
    train(keep_run, "merge_two_lane", two, "algo=mappo", crash_rate=0.3)
    train(keep_run, "merge", one[:3], "algo=maacktr")
    train(keep_run, "merge_two_lane", one[:3], "algo=maacktr")
    shown = tables(section(root))["scaling"]
    [maacktr, mappo] = shown.rows
    expected = stats.ttest_ind(two, one, equal_var=False).confidence_interval()
    figures = shown.exact.set_index("controller").loc[mappo[0]]
    assert figures["reward"] == pytest.approx(-10.0)
    assert [figures["reward_low"], figures["reward_high"]] == [pytest.approx(each) for each in expected]
    assert figures["crash_rate"] == pytest.approx(0.2)
    assert np.isnan(figures["crash_rate_low"])  # nothing varies
    assert mappo[-2:] == ["scales", "loses"]
    assert maacktr[-2:] == ["does not", "no claim (no difference shown)"]


def test_results_published_at_density_2_are_not_shown_beside_another_density(
    keep_run: Keep, root: Path
) -> None:
    for density in (1, 2):
        for env in ("merge", "merge_two_lane"):
            train(keep_run, env, [1.0, 2.0], "algo=madqn", f"env.args.density={density}")
    found = tables(section(root))
    ranges = [row[3] for row in found["merging"].rows if row[1].startswith("madqn")]
    assert sorted(ranges) == ["-100 to 50", "-100 to 50", "\N{EN DASH}", "\N{EN DASH}"]
    findings = [found[f"scaling_{pair}"].rows[0][-2] for pair in (1, 2)]
    assert sorted(findings) == ["does not learn", "\N{EN DASH}"]


def test_tasks_with_the_same_traffic_are_paired(keep_run: Keep, root: Path) -> None:
    train(keep_run, "merge", [1.0, 2.0], "env.args.supervisor=true")
    train(keep_run, "merge_two_lane", [1.0, 2.0])
    assert "scaling" not in tables(section(root))
    train(keep_run, "merge_two_lane", [3.0, 4.0], "env.args.supervisor=true")
    [row] = tables(section(root))["scaling"].rows
    assert row[2].startswith("+2")


def test_learners_trained_on_one_of_the_tasks_only_are_reported(keep_run: Keep, root: Path) -> None:
    train(keep_run, "merge", [1.0, 2.0], "algo=mappo")
    train(keep_run, "merge_two_lane", [1.0, 2.0], "algo=ippo")
    assert "No learner was trained on both" in words(section(root))


@pytest.mark.parametrize("make", [merge_section, intersection_section, bus_published_section])
def test_other_environments_have_no_such_section(
    make: Callable[[StudyData], Section | None], keep_run: Keep, root: Path
) -> None:
    keep_run(("experiment=toy_tracking",), 0, 10.0)
    assert make(StudyData(root, "study")) is None

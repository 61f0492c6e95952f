"""The report shows the store's results and notes missing ones."""

import csv
import io
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from shutil import copytree
from typing import Any

import pandas as pd
import pytest
from command_lines import refused
from matplotlib.axes import Axes
from sections import section_of, tables, words

from headway.contracts.errors import HeadwayError
from headway.stats import frames
from headway.stats.intervals import paired_difference_over_seeds
from headway.stats.pairs import LearnerDifference
from headway.store.atomic_files import write_json
from headway.store.run_folder import RunRecord, best_file
from headway_launch.commands.main import run as run_command
from headway_launch.report.elements import Listing, Picture, Report, Section, Table
from headway_launch.report.html_page import html
from headway_launch.report.sections import rewards as rewards_module
from headway_launch.report.sections.costs import tradeoff_section
from headway_launch.report.sections.learning import curves_section
from headway_launch.report.sections.rewards import final_reward_section
from headway_launch.report.study_data import StudyData
from headway_launch.report.study_report import report_of
from headway_launch.studies.runs import configuration, rule_phases

Keep = Callable[..., Path]
TRACKING, MATRIX = ("experiment=toy_tracking",), ("experiment=toy_matrix",)
KNOWN = {
    "kwh": 3e-5, "kg_co2": 3e-6, "cpu_kwh": 2e-5, "gpu_kwh": None, "ram_kwh": 1e-5,
    "energy.cpu": "estimated (cpu_load, 8 W at full load)", "energy.gpu": "not measured",
    "energy.ram": "estimated (by size)",
}  # fmt: skip
RULES = {"random": -20.0, "optimal": 10.0}


def made(root: Path, study: str = "study", metric: str | None = None, lower: bool = False) -> Report:
    return report_of(StudyData(root, study, metric, lower), "headway report")


def rewards(root: Path) -> Report:
    """Return the first section alone, which takes a fraction of the time."""
    return Report("", "", [], [section_of(root, final_reward_section)], "", "")


def text_of(report: Report) -> str:
    """Return all text of a report."""
    lines = [report.title, report.subtitle, *report.summary]
    for part in (part for section in report.sections for part in section.body):
        match part:
            case Table(caption=caption, headings=headings, rows=rows):
                lines += [caption, *headings, *(" ".join(row) for row in rows)]
            case Listing(text=text):
                lines.append(text)
            case Picture(caption=caption):
                lines.append(caption)
            case _:
                lines.append(part)
    return "\n".join(lines)


def axes_of(report: Report) -> dict[str, Axes]:
    """Return the first axes of its pictures by name."""
    parts = [part for section in report.sections for part in section.body]
    return {part.name: part.figure.axes[0] for part in parts if isinstance(part, Picture)}


def report_table(report: Report, name: str) -> Table:
    [found] = [tables(section)[name] for section in report.sections if name in tables(section)]
    return found


def table(report: Report, name: str) -> pd.DataFrame:
    return report_table(report, name).exact


def two_algorithms(keep_run: Keep, **more: float) -> None:
    for seed in range(3):
        keep_run((*TRACKING, "algo=ippo"), seed, 5.0 + seed, rules=RULES, energy=KNOWN, **more)
        keep_run((*TRACKING, "algo=ia2c"), seed, 2.0 * seed, rules=RULES, energy=KNOWN, **more)


@dataclass(frozen=True)
class Two:
    """A study of two algorithms with three seeds each, and its report."""

    root: Path
    report: Report


@pytest.fixture(scope="module")
def two(keep_run_in: Callable[[Path], Keep], tmp_path_factory: pytest.TempPathFactory) -> Two:
    """Shared by tests that leave its store as it is."""
    root = tmp_path_factory.mktemp("two") / "store"
    two_algorithms(keep_run_in(root))
    return Two(root, made(root))


def test_both_reward_sections_show_the_stored_values(two: Two) -> None:
    report = two.report
    published = table(report, "final_rewards").set_index("controller")
    ippo = published.loc["ippo"]
    assert [ippo[f"greedy_final_reward_{name}"] for name in ("mean", "std")] == [6.0, 1.0]
    assert ippo["training_final_reward_mean"] == 3.0
    # 0, half, 1, 1, 1 of the way up, at even steps; seed 0 of ia2c is flat, which is 0.5 by definition.
    assert ippo["greedy_auc_own_mean"] == pytest.approx(0.75)
    assert ippo["greedy_auc_study_mean"] == pytest.approx(0.75 * 6 / 7)
    assert published.loc["ia2c", "greedy_auc_own_mean"] == pytest.approx((0.5 + 2 * 0.75) / 3)
    assert published.loc["rule optimal", "greedy_final_reward_mean"] == 10.5  # episodes 0 and 1, as the curve
    assert "6.0 ± 1.0" in text_of(report)
    assert "except keys that do not affect results: where runs are stored" in text_of(report)

    sound = table(report, "interquartile_means").set_index("controller")
    learned = [[5.0 + seed + episode for episode in range(4)] for seed in range(3)]
    expected = paired_difference_over_seeds(learned, [[10.0 + episode for episode in range(4)]] * 3)
    found = [sound.loc["ippo", f"minus_best_rule{end}"] for end in ("", "_low", "_high")]
    assert found == pytest.approx([expected.estimate, expected.low, expected.high])
    assert sound.loc["rule random", "minus_best_rule"] == -30
    assert "no claim (worse)" in text_of(report)
    chances = table(report, "probability_of_improvement").set_index(["a", "b"]).loc[("ippo", "ia2c")]
    assert chances["probability"] == 1.0
    assert chances[["low", "high"]].isna().all()
    assert report_table(report, "probability_of_improvement").rows[1][1] == "1.000"


def test_every_result_of_the_summary_names_its_episodes(two: Two, keep_run: Keep, root: Path) -> None:
    report = two.report
    best, pairs, against, *_ = report.summary
    assert pairs.startswith("Of the learners, no pair is shown to differ in the last evaluation")
    assert best.endswith(
        "the highest mean return in the last evaluation: 7.500 over 3 seeds (4 episodes). The final reward "
        "below is another value: the mean over the last 20% of the curve, with 2 episodes per evaluation, "
        "the first of these."
    )
    assert "`optimal`, in the last evaluation (4 episodes) [95% intervals]" in against
    assert (
        "evaluated on 2 episodes per point of the curves, which are also the first 2 of the last "
        "evaluation's 4 episodes;" in text_of(report)
    )
    copytree(two.root, root)
    configured = keep_run((*TRACKING, "algo=ippo"), 3, 5.0) / "config.yaml"
    configured.write_text(configured.read_text().replace("  episodes: 2\n", "  episodes: 3\n"))
    assert "differing numbers of episodes per evaluation" in made(root).summary[0]


def test_budgets_that_differ_by_rounding_are_noted_below_tables(two: Two, keep_run: Keep, root: Path) -> None:
    assert "number of environment steps" not in text_of(two.report)
    copytree(two.root, root)
    for seed in range(3):
        longer = keep_run((*TRACKING, "algo=coma"), seed, 1.0, rules=RULES, energy=KNOWN)
        record = json.loads((longer / "run.json").read_text())
        (longer / "run.json").write_text(json.dumps({**record, "durable_env_steps": 1048}))
    line = "`coma` 1,048, `ia2c` 40, `ippo` 40."
    assert text_of(made(root)).count(f"rounded up to whole iterations): {line}") == 1


def test_report_warns_of_narrow_intervals_over_few_seeds(keep_run: Keep, root: Path) -> None:
    for seed in range(10):
        keep_run(TRACKING, seed, 5.0 + seed, study="enough")
    assert "too narrow" not in text_of(made(root, "enough"))
    for seed in range(2):
        keep_run((*TRACKING, "algo=ippo"), seed, 5.0 + seed)
        keep_run((*TRACKING, "algo=ia2c"), seed, 2.0 * seed)
    # Under both tables, and in the captions of both pictures with such intervals.
    assert text_of(made(root)).count("With fewer than 10 seeds, bootstrap intervals are too narrow") == 4


def test_captions_name_a_cell_that_diverged(
    two: Two, keep_run: Keep, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rewards_module, "SEEDS_FOR_A_PROFILE", 2)
    copytree(two.root, root)
    for seed in range(2):
        keep_run((*TRACKING, "algo=ddpg"), seed, -98_439.0 - seed)
    report = report_of(StudyData(root, "study", low=-30.0), "headway report")
    assert "Outside the axis: ddpg (-98,440)." in text_of(report)
    pictures = axes_of(report)
    assert pictures["profiles"].get_xlim()[0] > -10
    assert pictures["learning_curves"].get_ylim()[0] == -30
    assert pictures["reward_against_cost"].get_ylim()[0] > -30


@pytest.mark.parametrize("low", ["nan", "-inf", "99"])
def test_an_axis_that_cannot_begin_there_is_one_line(low: str, two: Two) -> None:
    line = f"the axis cannot begin at {low}: give a number below "
    assert line in refused("report", "study", "--store", str(two.root), f"--low={low}")


@pytest.mark.parametrize("diverged", [False, True])
def test_if_lower_is_better_a_far_lower_cell_is_drawn(
    diverged: bool, two: Two, keep_run: Keep, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rewards_module, "SEEDS_FOR_A_PROFILE", 2)
    copytree(two.root, root)
    for seed in range(2):
        keep_run((*TRACKING, "algo=ddpg"), seed, 98_000.0 if diverged else -98_000.0, energy=KNOWN)
    report = made(root, lower=True)
    assert ("Outside the axis: ddpg" in text_of(report)) == diverged
    pictures = axes_of(report)
    for name in ("learning_curves", "intervals", "profiles", "reward_against_cost"):
        reach = [*pictures[name].get_xlim(), *pictures[name].get_ylim()]
        assert (max(map(abs, reach)) > 50_000) != diverged, name


def test_runs_with_few_evaluations_have_no_auc(keep_run: Keep, root: Path) -> None:
    """The mean over seeds does not count them as 0.5 either."""
    remark = "fewer than 3 points gets no AUC"
    keep_run((*TRACKING, "algo=ippo"), 0, 1.0)
    assert remark not in text_of(rewards(root))
    keep_run((*TRACKING, "algo=ippo"), 1, 1.0, points=2)
    keep_run((*TRACKING, "algo=ia2c"), 0, 1.0, points=2)
    report = rewards(root)
    assert remark in text_of(report)
    assert "This applies to the training curve of 2 runs (points: iterations" in text_of(report)
    assert "and the greedy curve of 2 runs (points: set by `evaluation.every`)." in text_of(report)
    published = table(report, "final_rewards").set_index("controller")
    areas = published[["training_auc_own_mean", "greedy_auc_own_mean"]]
    assert areas.loc["ippo"].tolist() == [pytest.approx(0.75)] * 2
    assert areas.loc["ia2c"].isna().all()
    assert math.isnan(published.loc["ia2c", "greedy_auc_study_mean"])


def test_training_columns_need_no_common_step(keep_run: Keep, root: Path) -> None:
    """Asynchronous workers end episodes at other updates in each run."""
    keep_run((*TRACKING, "algo=a3c"), 0, 4.0, rules=RULES, trained=(0, 2, 4))
    keep_run((*TRACKING, "algo=a3c"), 1, 8.0, rules=RULES, trained=(1, 3))
    report = rewards(root)
    a3c = table(report, "final_rewards").set_index("controller").loc["a3c"]
    assert a3c["training_final_reward_mean"] == 3.0  # half of 4 and of 8
    assert a3c["training_auc_own_mean"] == pytest.approx(0.75)  # of seed 0: seed 1 has but two points
    assert a3c["training_auc_study_mean"] == pytest.approx(0.75 * 2 / 4)
    assert "ended during training in 1 run" not in text_of(report)
    short = "This applies to the training curve of 1 run (points: iterations in which episodes ended)."
    assert short in text_of(report)
    keep_run((*TRACKING, "algo=a3c"), 2, 100.0, rules=RULES, trained=())
    with_one_more = rewards(root)
    a3c = table(with_one_more, "final_rewards").set_index("controller").loc["a3c"]
    assert (a3c["seeds"], a3c["training_final_reward_mean"]) == (3, 3.0)
    line = "No episode ended during training in 1 run: the training columns cover the remaining runs."
    assert line in text_of(with_one_more)
    assert short in text_of(with_one_more)  # a run without points has no curve


def test_training_columns_are_omitted_if_no_episode_ended(keep_run: Keep, root: Path) -> None:
    keep_run((*TRACKING, "algo=ippo"), 0, 4.0, rules=RULES, trained=())
    report = rewards(root)
    assert "There are no training columns because no episode ended during training." in text_of(report)
    shown = tables(report.sections[0])["final_rewards"]
    assert not [name for name in shown.headings if name.startswith("training")]
    assert {len(row) for row in shown.rows} == {len(shown.headings)} == {5}


def test_controllers_with_different_training_rewards_are_named(keep_run: Keep, root: Path) -> None:
    remark = "In the training columns, compare only controllers"
    own, alike = "env.training_args.reward.scope=own", "env.training_args.reward.scope=global"
    merge = ("env=merge",)
    keep_run((*merge, "algo=ippo", own), 0, 1.0)
    keep_run((*merge, "algo=ia2c", own), 0, 1.0)
    assert remark not in text_of(rewards(root))
    keep_run((*merge, "algo=coma"), 0, 1.0)
    keep_run((*merge, "algo=mappo", alike), 0, 1.0)  # the environment's default
    assert remark in (told := text_of(rewards(root)))
    assert "trained with the same reward: coma, mappo; ia2c, ippo." in told


def test_every_part_is_a_file_and_the_page_is_self_contained(keep_run: Keep, root: Path) -> None:
    two_algorithms(keep_run, reward_service=1.5, reward_regularity=-0.5)
    folder = root.parent / "report"
    assert run_command(["report", "study", "--store", str(root), "--output", str(folder)]) == 0
    page = (folder / "report.html").read_text()
    pictures = {path.stem for path in (folder / "pictures").iterdir()}
    assert {"learning_curves", "sample_efficiency", "components", "footprint"} < pictures
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in (folder / "pictures").iterdir())
    assert page.count('<img src="data:image/svg+xml;base64,') == len(pictures)
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert len(list((folder / "configs").iterdir())) == 2
    assert {path.suffix for path in (folder / "tables").iterdir()} == {".csv"}
    figures = list(csv.DictReader(io.StringIO((folder / "tables" / "episode_metrics.csv").read_text())))
    assert figures[-1]["ippo"] == "-0.5"


def test_energy_stands_beside_cpu_seconds(two: Two) -> None:
    report = two.report
    ippo = table(report, "energy").set_index("controller").loc["ippo"]
    assert (ippo["kwh"], ippo["cpu_seconds"]) == pytest.approx((3e-5, 4.0))
    assert math.isnan(ippo["gpu_kwh"])
    assert "mWh per run" in text_of(report)
    assert "CPU estimated (cpu_load, 8 W at full load); GPU not measured" in text_of(report)


@pytest.mark.parametrize("country", ["FRA", None])
def test_co2_is_shown_only_with_its_country(keep_run: Keep, root: Path, country: str | None) -> None:
    chosen = (*TRACKING, f"energy.country={country or 'null'}")
    for seed in range(2):
        energy = {**KNOWN, "kg_co2": 3e-6 if country else None}
        keep_run(chosen, seed, 1.0, rules=RULES, energy=energy)
    report = made(root)
    assert "mWh per run" in text_of(report)
    assert ("CO2 with the energy mix of FRA" in text_of(report)) == (country is not None)
    assert ("no CO2, as no energy.country is set" in text_of(report)) == (country is None)
    assert ("mg CO2eq per run" in text_of(report)) == (country is not None)
    assert ("of CO2eq" in text_of(report)) == (country is not None)


def test_co2_known_for_some_runs_of_a_cell_only_is_not_shown(keep_run: Keep, root: Path) -> None:
    for seed in range(2):
        for algorithm in ("ippo", "ia2c"):
            known = seed == 0 or algorithm == "ia2c"
            energy = {**KNOWN, "kg_co2": 3e-6 if known else None}
            country = f"energy.country={'FRA' if known else 'null'}"
            keep_run((*TRACKING, f"algo={algorithm}", country), seed, 1.0, rules=RULES, energy=energy)
    report = made(root)
    energies = table(report, "energy").set_index("controller")["kg_co2"]
    assert math.isnan(energies["ippo"])
    assert energies["ia2c"] == pytest.approx(3e-6)
    assert "1 run had no `energy.country`" in text_of(report)
    assert "of CO2eq" not in text_of(report)


def test_energy_that_was_not_measured_is_not_zero(keep_run: Keep, root: Path) -> None:
    for seed in range(2):
        keep_run((*TRACKING, "energy=off"), seed, 1.0, rules=RULES)
    report = made(root)
    assert "Energy was not measured for these runs" in text_of(report)
    assert "their energy was not measured" in text_of(report)
    assert "so CPU seconds are shown instead" in text_of(report)
    assert not any("energy" in tables(section) for section in report.sections)
    assert "footprint" not in axes_of(report)


@pytest.mark.parametrize(
    ("energy", "title"),
    [
        (KNOWN, "Reward against energy"),
        ({}, "Reward against CPU seconds"),
        ({"cpu_seconds": None}, "Reward against cost"),
    ],
)
def test_title_names_the_cost(keep_run: Keep, root: Path, energy: Mapping[str, Any], title: str) -> None:
    for seed in range(2):
        keep_run(TRACKING, seed, 1.0, energy=energy)
    section = section_of(root, tradeoff_section)
    assert section.title == title
    assert any(isinstance(part, Picture) for part in section.body) == (title != "Reward against cost")


def test_runs_without_energy_are_noted_and_excluded_from_its_means(keep_run: Keep, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0, energy=KNOWN)
    keep_run(TRACKING, 1, 1.0)
    report = made(root)
    assert "1 run had no measurement" in text_of(report)
    assert table(report, "energy")["runs"].tolist() == [1]
    # CPU seconds of the same run, 3, and not of both, 7.
    assert "The 1 of 2 finished runs with measured energy used" in text_of(report)
    assert "(3 CPU seconds)" in text_of(report)


def test_a_single_seed_and_missing_rules_are_noted(keep_run: Keep, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0)
    report = made(root)
    assert "Only one seed of ippo was trained: the variation" in text_of(report)
    assert "The store has no episodes of classical rules" in text_of(report)
    assert "The study has only one learner" in text_of(report)
    assert "There is no performance profile: it needs at least 5 seeds per controller." in text_of(report)
    assert not {"intervals", "profiles"} & set(axes_of(report))
    keep_run((*TRACKING, "algo=ia2c"), 0, 1.0)
    assert "Only one seed each of ia2c, ippo was trained" in text_of(made(root))


def test_lookahead_measures_the_possible_gain_and_is_never_the_best_rule(keep_run: Keep, root: Path) -> None:
    """On the four episodes of the last evaluation the rules have means of 11.5 and 21.5, the learner 14."""
    for seed in range(2):
        keep_run(TRACKING, seed, 12.0 + seed, rules={**RULES, "lookahead": 20.0})
    report = made(root)
    text = text_of(report)
    assert "gap from optimal, the best of the rules played, to lookahead, a reference that simulates" in text
    assert ": 10 (95% interval 10 to 10); of this gap, ippo closes 25%." in text
    found = table(report, "interquartile_means").set_index("controller")
    assert found.loc["ippo", "minus_best_rule"] == pytest.approx(2.5)
    assert found.loc["rule lookahead", "minus_best_rule"] == pytest.approx(10.0)
    assert StudyData(root, "study").scale == {"tracking": (-19.5, 10.5)}


def test_shares_of_a_gap_are_over_the_episodes_that_all_seeds_have(keep_run: Keep, root: Path) -> None:
    """One seed of ippo has two of the four episodes: the rules have means of 10.5 and 20.5 on these, the
    learners 13 and 15.5. The other two episodes would add 1 to each."""
    for seed, last in ((0, 4), (1, 2)):
        keep_run((*TRACKING, "algo=ippo"), seed, 12.0 + seed, rules={**RULES, "lookahead": 20.0}, last=last)
        keep_run((*TRACKING, "algo=ia2c"), seed, 15.0, rules={**RULES, "lookahead": 20.0})
    text = text_of(made(root))
    assert ": 10 (95% interval 10 to 10); of this gap, ia2c closes 50%, ippo closes 25%." in text
    assert "nan" not in text.partition("gap from")[2].splitlines()[0]


def test_no_gap_is_given_where_cells_were_evaluated_on_different_episodes(keep_run: Keep, root: Path) -> None:
    for more in (("algo=ippo",), ("algo=ia2c", "evaluation.seed=5")):
        keep_run((*TRACKING, *more), 0, 12.0, rules={**RULES, "lookahead": 20.0})
    text = text_of(made(root))
    assert "the cells were evaluated on different episodes" in text
    assert "gap from" not in text


def test_a_learner_without_common_episodes_has_no_share(keep_run: Keep, root: Path) -> None:
    keep_run((*TRACKING, "algo=ippo"), 0, 12.0, rules={**RULES, "lookahead": 20.0}, last=1)
    keep_run((*TRACKING, "algo=ia2c"), 0, 15.0, rules={**RULES, "lookahead": 20.0})
    text = text_of(made(root))
    assert ": 10 (95% interval 10 to 10); of this gap, ia2c closes 50%." in text


def test_lookahead_alone_is_no_rule_to_compare_with(keep_run: Keep, root: Path) -> None:
    keep_run(TRACKING, 0, 12.0, rules={"lookahead": 20.0})
    assert "The store has no episodes of classical rules" in text_of(made(root))


def test_excluded_runs_are_noted_with_the_reason(keep_run: Keep, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0)
    keep_run(TRACKING, 1, 2.0, status="KILLED")
    failed = keep_run(TRACKING, 2, 3.0, status="FAILED")
    (failed / "traceback.txt").write_text("Traceback\n  somewhere\nValueError: NaN in `layer 2\n")
    keep_run(TRACKING, 3, 4.0, status="RUNNING")
    report = made(root)
    assert (
        "Excluded from all results on this page: 3 not finished (1 FAILED, 1 KILLED, 1 RUNNING)"
        in text_of(report)
    )
    assert f"{failed.name} failed: ValueError: NaN in 'layer 2" in text_of(report)
    assert table(report, "runs")["included"].tolist() == [True, False, False, False]
    assert table(report, "runs")["duration_s"].isna().tolist() == [False, False, False, True]


def test_a_damaged_run_is_excluded_and_counted(
    keep_run: Keep, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [keep_run(TRACKING, seed, 1.0 + seed) for seed in range(5)]
    (runs[1] / "config.yaml").write_text("{[")
    (runs[2] / "run.json").write_text("{[")
    [evaluations] = runs[4].glob("evaluation-*")
    evaluations.unlink()
    report = made(root)
    assert "Excluded from all results on this page: 3 damaged." in text_of(report)
    listed = table(report, "runs")
    assert dict(zip(listed["run_id"], listed["included"], strict=True)) == {
        runs[0].name: True, runs[1].name: False, runs[3].name: True, runs[4].name: False,
    }  # fmt: skip
    assert "FINISHED, excluded" in text_of(report)
    lines = capsys.readouterr().err.splitlines()
    assert [str(run) in " ".join(lines) for run in runs] == [False, True, True, False, True]


def test_a_report_of_the_runs_that_meet_a_condition(keep_run: Keep, root: Path, tmp_path: Path) -> None:
    for seed in range(3):
        keep_run((*TRACKING, "algo=ippo"), seed, 1.0)
        keep_run((*TRACKING, "algo=ia2c"), seed, 2.0)
    words = [
        "report",
        "study",
        "--store",
        str(root),
        "--output",
        str(tmp_path / "page"),
        "--format",
        "markdown",
    ]
    assert run_command([*words, "--where", "algorithm=ippo", "--where", "seed<2"]) == 0
    page = (tmp_path / "page" / "report.md").read_text()
    assert "tracking: 2 finished runs of 1 learner" in page
    assert "Excluded runs: 4 that do not meet `--where`." in page
    line = "--where: no finished run of study matches"
    assert line in refused(*words, "--where", "algorithm=mappo")


def test_environments_are_aggregated_if_rules_give_them_a_scale(keep_run: Keep, root: Path) -> None:
    for seed in range(2):
        keep_run((*TRACKING, "algo=ippo"), seed, 10.5, rules=RULES)
        keep_run((*MATRIX, "algo=ippo"), seed, 2.0, rules={"random": 0.0, "optimal": 3.0})
        keep_run((*MATRIX, "algo=ia2c"), seed, 1.0, rules={"random": 0.0, "optimal": 3.0})
    report = made(root)
    assert report.subtitle == "tracking; matrix: 6 finished runs of 2 learners, and 2 classical rules"
    [row] = table(report, "across_environments").to_dict("records")
    # On the curves' episodes 0 and 1, tracking's rules score -19.5 and 10.5, matrix's 0.5 and 3.5.
    assert (row["controller"], row["mean"]) == ("ippo", pytest.approx((1 + 0.5) / 2))
    assert "Excluded, because they were not trained on every environment: ia2c" in text_of(report)


def test_environments_without_a_scale_are_not_aggregated(keep_run: Keep, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0, rules=RULES)
    keep_run(MATRIX, 0, 2.0, rules={"optimal": 3.0})
    report = made(root)
    told = text_of(report)
    assert "Scores cannot be aggregated: matrix lacks the random rule (score 0) or a rule" in told
    assert "add `random` and at least one rule that beats it to `evaluation.rules`" in told
    assert not any("across_environments" in tables(section) for section in report.sections)


def test_learners_are_ranked_over_environments(keep_run: Keep, root: Path) -> None:
    """Normalised by the rules: tracking's score 0 at -19.5 and 1 at 10.5, matrix's at 0.5 and 3.5."""
    for seed in range(2):
        for algorithm, of_tracking, of_matrix in (
            ("ippo", 9.0, 2.0),
            ("ia2c", 6.0, 1.0),
            ("mappo", 3.0, 3.0),
        ):
            keep_run((*TRACKING, f"algo={algorithm}"), seed, of_tracking, rules=RULES)
            rules = {"random": 0.0, "optimal": 3.0}
            keep_run((*MATRIX, f"algo={algorithm}"), seed, of_matrix, rules=rules)
    report = made(root)
    ranked = table(report, "ranks").set_index("controller")
    assert ranked["average_rank"].to_dict() == {"ippo": 1.5, "mappo": 2.0, "ia2c": 2.5}
    assert ranked.loc["mappo", ["tracking", "matrix"]].tolist() == [3, 1]
    pairs = table(report, "rank_pairs").set_index(["a", "b"])
    expected = ((9.0 - 3.0) / 30 + (2.0 - 3.0) / 3) / 2
    assert pairs.loc[("ippo", "mappo"), "difference"] == pytest.approx(expected)
    assert pairs["p_holm"].tolist() == [1.0, 1.0, 1.0]
    [shown] = [
        part for section in report.sections for part in tables(section).values() if part.name == "rank_pairs"
    ]
    assert shown.caption.endswith("p (Holm) cannot be below 1.000 here.")
    across = table(report, "across_environments").set_index("controller")
    assert across.loc["ippo", "matrix: mean"] == pytest.approx((2.0 - 0.5) / 3)
    assert "chi-squared 1, p " in text_of(report)  # 12 2 / (3 4) (0.5^2 + 0 + 0.5^2)
    names = [text.get_text() for text in axes_of(report)["ranks"].texts]
    assert names == ["ippo (1.5)", "mappo (2)", "ia2c (2.5)"]


def test_ranks_need_no_scale(keep_run: Keep, root: Path) -> None:
    for algorithm, cost in (("ippo", 2.0), ("ia2c", 3.0)):
        keep_run((*TRACKING, f"algo={algorithm}"), 0, cost, wait=cost)
        keep_run((*MATRIX, f"algo={algorithm}"), 0, cost, wait=cost)
    report = made(root, metric="evaluation_greedy/wait", lower=True)
    ranked = table(report, "ranks").set_index("controller")["average_rank"]
    assert ranked.to_dict() == {"ippo": 1.0, "ia2c": 2.0}
    assert not any("rank_pairs" in tables(section) for section in report.sections)


def test_learners_are_compared_in_pairs_by_their_seeds_and_common_episodes(two: Two) -> None:
    [row] = table(two.report, "learner_pairs").to_dict("records")
    learned = {
        "ia2c": [[2.0 * seed + episode for episode in range(4)] for seed in range(3)],
        "ippo": [[5.0 + seed + episode for episode in range(4)] for seed in range(3)],
    }
    expected = LearnerDifference.of(*learned.values())
    assert (row["controller"], row["minus"]) == ("ia2c", "ippo")
    assert [row[name] for name in ("difference", "low", "high")] == pytest.approx(
        [expected.interval.estimate, expected.interval.low, expected.interval.high]
    )
    assert row["p"] == row["p_holm"] == pytest.approx(expected.p_value)
    assert row["seeds_needed"] == expected.seeds_needed()
    runs = StudyData(two.root, "study").runs
    [alike] = frames.learner_pairs(runs.evaluations(["return"], mode="greedy", final=True)).to_dict("records")
    assert [alike[name] for name in ("p", "p_holm", "seeds_needed")] == [
        row[name] for name in ("p", "p_holm", "seeds_needed")
    ]
    assert "p (Holm): of a single pair. Seeds needed: seeds per learner" in text_of(two.report)


def test_the_summary_says_which_learners_differ_with_enough_seeds(keep_run: Keep, root: Path) -> None:
    for seed in range(10):
        keep_run((*TRACKING, "algo=ippo"), seed, 9.0 + seed % 3)
        keep_run((*TRACKING, "algo=ia2c"), seed, 2.0 + seed % 2)
    assert made(root).summary[1] == (
        "Of the learners, 1 of 1 pair differs in the last evaluation, with p corrected by Holm below 5% and "
        "at least 10 seeds of both: `ippo` is better than `ia2c`."
    )
    costs = report_of(StudyData(root, "study", lower_is_better=True), "headway report").summary[1]
    assert costs.endswith("`ia2c` is better than `ippo`.")
    keep_run((*TRACKING, "algo=mappo"), 0, 99.0)
    assert "Of the learners, 1 of 3 pairs differs" in made(root).summary[1]


def test_a_report_of_several_studies_joins_their_environments(
    keep_run: Keep, keep_run_in: Callable[[Path], Keep], root: Path, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    for seed in range(2):
        keep_run((*TRACKING, "algo=ippo"), seed, 1.0, rules=RULES)
        rules = {"random": 0.0, "optimal": 3.0}
        keep_run_in(elsewhere)((*MATRIX, "algo=ippo"), seed, 2.0, study="game", rules=rules)
    keep_run_in(elsewhere)((*MATRIX, "algo=ippo"), 2, 2.0, "FAILED", study="game")
    report = report_of(StudyData(root, "study", others=[(elsewhere, "game")]), "headway report")
    assert report.title == "Studies study, game"
    assert report.subtitle == "tracking; matrix: 4 finished runs of 1 learner, and 2 classical rules"
    assert "Excluded runs: 1 not finished (1 FAILED) of game." in report.summary
    assert table(report, "across_environments")["mean"].tolist() == pytest.approx(
        [((1 + 19.5) / 30 + (2 - 0.5) / 3) / 2]
    )


def test_studies_with_a_cell_in_common_are_refused(keep_run: Keep, root: Path) -> None:
    for study in ("study", "again"):
        keep_run((*TRACKING, "algo=ippo"), 0, 1.0, study=study)
    line = refused("report", "study", "again", "--store", str(root))
    assert "studies study and again both have runs of tracking-ippo-" in line
    assert "a report cannot tell them apart, but `headway compare` can" in line
    assert "study 'study' is named twice" in refused("report", "study", "study", "--store", str(root))
    assert "there is no store in 'no/runs'" in refused("report", "no/runs:study", "--store", str(root))


def test_the_absolute_metric_is_of_the_best_policies_on_new_episodes(keep_run: Keep, root: Path) -> None:
    folders = [keep_run((*TRACKING, "algo=ippo"), seed, 5.0 + seed, rules=RULES) for seed in range(3)]
    assert not any(section.anchor == "absolute_metric" for section in made(root).sections)
    values = {0: [1.0, 2.0, 6.0], 1: [4.0, 4.0, 4.0]}
    kept = {
        folders[seed].name: {"iteration": 2, "episodes": [{"return": value} for value in own]}
        for seed, own in values.items()
    }
    rules = {"optimal": [{"return": value} for value in (3.0, 3.0, 4.0)]}
    record = RunRecord.read(folders[0])
    path = best_file(root, "study", record.cell)
    write_json(path, {"seed": 7, "mode": "greedy", "rules": rules, "runs": kept})
    report = made(root)
    found = table(report, "absolute_metric").set_index("controller")
    ippo = found.loc["ippo"]
    assert (ippo["runs"], ippo["mean"], ippo["std"]) == (2, 3.5, pytest.approx(math.sqrt(0.5)))
    expected = paired_difference_over_seeds(list(values.values()), [[3.0, 3.0, 4.0]] * 2)
    assert ippo["minus_best_rule"] == pytest.approx(expected.estimate)
    assert ippo["minus_best_rule_high"] == pytest.approx(expected.high)
    assert found.loc["rule optimal", "mean"] == pytest.approx(10 / 3)
    assert "ippo: 2 of its 3 seeds; Evaluated: 3 episodes per seed." in text_of(report)
    path.write_text('{"mode": "greedy"}')
    with pytest.raises(HeadwayError, match=r"is damaged or lacks return; write it again with .*--keep"):
        made(root)
    path.write_text('{"mode": "sampled"}')
    assert not any(section.anchor == "absolute_metric" for section in made(root).sections)


def test_the_absolute_metric_is_of_the_episodes_that_have_it(keep_run: Keep, root: Path) -> None:
    folders = [keep_run((*TRACKING, "algo=ippo"), seed, 5.0 + seed, rules=RULES) for seed in range(2)]
    nan = math.nan
    values = [[1.0, nan, 2.0, 6.0, 9.0], [4.0, 8.0, 4.0, 4.0, 9.0]]
    kept = {
        folder.name: {"iteration": 2, "episodes": [{"return": value} for value in own]}
        for folder, own in zip(folders, values, strict=True)
    }
    rules = {"optimal": [{"return": value} for value in (3.0, 3.0, 3.0, 4.0, nan)]}
    path = best_file(root, "study", RunRecord.read(folders[0]).cell)
    write_json(path, {"seed": 7, "mode": "greedy", "rules": rules, "runs": kept})
    report = made(root)
    ippo = table(report, "absolute_metric").set_index("controller").loc["ippo"]
    assert ippo["mean"] == pytest.approx((1 + 2 + 6 + 9 + 4 + 4 + 4 + 9) / 8)
    expected = paired_difference_over_seeds([[1.0, 2.0, 6.0], [4.0, 4.0, 4.0]], [[3.0, 3.0, 4.0]] * 2)
    assert ippo["minus_best_rule"] == pytest.approx(expected.estimate)
    assert ippo["minus_best_rule_low"] == pytest.approx(expected.low)
    assert "Evaluated: 4 episodes per seed." in text_of(report)


def test_the_absolute_metric_of_a_study_without_rules_is_beside_the_best_stored_rule(
    keep_run: Keep, root: Path
) -> None:
    folder = keep_run((*TRACKING, "algo=ippo"), 0, 5.0)
    values = {"random": 1.0, "optimal": 3.0, "lookahead": 9.0}
    rules = {rule: [{"return": value + episode} for episode in range(3)] for rule, value in values.items()}
    runs = {folder.name: {"iteration": 2, "episodes": [{"return": value} for value in (5.0, 6.5, 6.5)]}}
    path = best_file(root, "study", RunRecord.read(folder).cell)
    write_json(path, {"seed": 7, "mode": "greedy", "rules": rules, "runs": runs})
    found = table(made(root), "absolute_metric").set_index("controller")
    assert found.loc["ippo", "minus_best_rule"] == pytest.approx(6 - 4)


def test_different_evaluation_episodes_give_no_difference(keep_run: Keep, root: Path) -> None:
    keep_run((*TRACKING, "algo=ippo"), 0, 1.0, rules=RULES)
    keep_run((*TRACKING, "algo=ia2c", "evaluation.seed=5"), 0, 1.0, rules=RULES)
    line = "best rule is given for tracking: the cells were evaluated on different episodes"
    told = text_of(made(root))
    assert line in told
    assert "not evaluated on common episodes of a last evaluation" in told
    for algorithm in ("ippo", "ia2c"):
        keep_run((*MATRIX, f"algo={algorithm}"), 0, 1.0)
    report = made(root)
    assert "Differences between learners on matrix" in text_of(report)
    assert "on common episodes of a last evaluation on tracking, so" in text_of(report)


def test_a_damaged_file_of_rules_is_left_out(
    keep_run: Keep, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = keep_run(TRACKING, 0, 1.0, rules=RULES)
    [played] = folder.parent.glob("*.rules.json")
    played.write_text(played.read_text()[:-9])
    report = made(root)
    assert "0 classical rules" in report.subtitle
    assert "The store has no episodes of rules on tracking, so it is unknown" in text_of(report)
    assert f"headway: rules are left out: {played} cannot be read (" in capsys.readouterr().err


def test_a_single_episode_gives_no_difference(keep_run: Keep, root: Path) -> None:
    folder = keep_run(TRACKING, 0, 1.0, rules=RULES)
    [played] = folder.parent.glob("*.rules.json")
    played.write_text(json.dumps({rule: days[:1] for rule, days in json.loads(played.read_text()).items()}))
    line = "is `optimal`; the learners' difference from it is unknown: fewer than two"
    assert line in text_of(made(root))


def test_learners_whose_difference_is_unknown_are_named_beside_the_others(keep_run: Keep, root: Path) -> None:
    for seed in range(3):
        keep_run((*TRACKING, "algo=ippo"), seed, 20.0 + seed, rules=RULES)
    keep_run((*TRACKING, "algo=ia2c"), 0, 1.0, rules=RULES, last=1)
    against = made(root).summary[1]
    assert "[95% intervals]: no claim (above it): `ippo` (+11" in against
    assert against.endswith("; unknown: `ia2c` (fewer than two common episodes).")


def test_the_summary_claims_a_difference_from_the_best_rule_with_ten_seeds(
    keep_run: Keep, root: Path
) -> None:
    for seed in range(10):
        keep_run((*TRACKING, "algo=ippo"), seed, 20.0 + seed % 3, rules=RULES)
        if seed < 9:
            keep_run((*TRACKING, "algo=ia2c"), seed, 2.0, rules=RULES)
    assert re.search(r": above it: `ippo` \([^)]+\); no claim \(below it\): `ia2c`", made(root).summary[2])
    assert re.search(
        r": worse, above it: `ippo` \([^)]+\); no claim \(worse, above it\): `ia2c`",
        made(root, lower=True).summary[2],
    )


def test_learners_without_a_common_evaluation_step_are_named(keep_run: Keep, root: Path) -> None:
    for algorithm in ("ippo", "ia2c"):
        keep_run((*TRACKING, f"algo={algorithm}"), 0, 1.0, rules=RULES)
        keep_run((*MATRIX, f"algo={algorithm}"), 0, 2.0, rules={"random": 0.0, "optimal": 3.0})
    data = StudyData(root, "study")
    for learner, line in (
        ("ia2c", "for ia2c: its runs have no evaluation step in common."),
        ("ippo", "for ia2c, ippo: the runs of each have no evaluation step in common."),
    ):
        shifted = (data.curves["task"] == "matrix") & (data.curves["controller"] == learner)
        data.curves.loc[shifted, "env_steps"] += 5  # points are 10 steps apart
        assert f"No sample-efficiency curve {line}" in words(curves_section(data))


def test_another_reward_in_training_is_noted(keep_run: Keep, root: Path) -> None:
    keep_run((*TRACKING, "env.training_args={effort: 0.5}"), 0, 1.0)
    assert "the training columns show the training reward and cannot be compared" in text_of(rewards(root))


def test_stages_are_drawn_on_a_task_if_all_its_cells_have_them(keep_run: Keep, root: Path) -> None:
    stages = "stages=[{env_steps: 70000}, {env_steps: 30000}]"
    keep_run((*TRACKING, "algo=ippo", "env_steps=100_000", stages), 0, 1.0)
    data = StudyData(root, "study")
    rollout = configuration(data.runs.rows[0].directory)["rollout"]
    [[end]] = data.stage_ends.values()
    assert 70_000 <= end < 70_000 + rollout["copies"] * rollout["steps"]
    keep_run((*TRACKING, "algo=ia2c", "env_steps=100_000"), 0, 1.0)
    data = StudyData(root, "study")
    assert (len(data.tasks), data.stage_ends) == (1, {})


def test_starts_from_a_rule_are_rows_of_one_table(keep_run: Keep, root: Path) -> None:
    start = ("start.rule=optimal", "start.env_steps=20_000", "env_steps=100_000")
    for algo in ("ippo", "ia2c"):
        keep_run((*TRACKING, f"algo={algo}", *start), 0, 1.0, rules=RULES)
    report = made(root)
    assert table(report, "starts")[["controller", "rule", "played"]].to_numpy().tolist() == [
        ["ia2c", "optimal", 10.5],
        ["ippo", "optimal", 10.5],
    ]
    assert "started from rule" not in text_of(report).replace("Controllers that started from a rule", "")


def test_the_phase_of_a_rule_is_known_per_learner(keep_run: Keep, root: Path) -> None:
    start = ("start.rule=optimal", "start.env_steps=20_000")
    keep_run((*TRACKING, "algo=ippo", "env_steps=100_000", *start), 0, 1.0)
    keep_run((*TRACKING, "algo=ia2c", "env_steps=100_000"), 0, 1.0)
    data = StudyData(root, "study")
    [phases] = rule_phases(data.runs).values()
    [(rule, steps)] = phases.values()
    rollout = configuration(data.runs.rows[0].directory)["rollout"]
    assert rule == "optimal"
    assert 20_000 <= steps < 20_000 + rollout["copies"] * rollout["steps"]
    caption = next(part.caption for part in curves_section(data).body if isinstance(part, Picture))
    assert caption.endswith("; shaded: the rule of `start.rule` acts.")


def test_lower_costs_are_better(keep_run: Keep, root: Path) -> None:
    for seed in range(2):
        keep_run((*TRACKING, "algo=ippo"), seed, 1.0, rules=RULES, wait=2.0)
        keep_run((*TRACKING, "algo=ia2c"), seed, 9.0, rules=RULES, wait=7.0)
    report = made(root, metric="evaluation_greedy/wait", lower=True)
    assert "`ippo` has the lowest mean wait in the last evaluation: 2 over 2 seeds" in text_of(report)
    assert "training: final wait" not in text_of(report)
    assert "training: final reward" in text_of(report)
    chances = table(report, "probability_of_improvement").set_index("a")["probability"]
    assert chances["ippo"] == 1


def test_metrics_have_units_and_rules_one_order_in_tables_and_pictures(keep_run: Keep, root: Path) -> None:
    rules = {"random": 3.0, "idle": 1.0, "idm_mobil": 2.0}
    for seed in range(2):
        keep_run(("experiment=merge_mappo",), seed, 5.0 + seed, rules=rules, mean_speed_ms=22.0)
    report = made(root, metric="mean_speed_ms")
    assert "IQM of final mean speed, m/s [95%]" in report_table(report, "interquartile_means").headings
    assert "greedy: final mean speed, m/s" in report_table(report, "final_rewards").headings
    assert "mean speed, m/s" in [row[0] for row in report_table(report, "episode_metrics").rows]
    pictures = axes_of(report)
    assert pictures["learning_curves"].get_ylabel() == "greedy: mean speed, m/s"
    assert pictures["intervals"].get_xlabel() == "IQM of final mean speed, m/s"
    report = made(root, lower=True)
    order = ["rule idle", "rule idm_mobil", "rule random"]
    for name in ("final_rewards", "interquartile_means"):
        shown = [cell for row in report_table(report, name).rows for cell in row if cell in order]
        assert shown == order, name
    assert [word for word in report_table(report, "episode_metrics").headings if word in order] == order
    for name in ("learning_curves", "intervals"):
        lines = [str(line.get_label()).partition(" (")[0] for line in axes_of(report)[name].lines]
        assert [line for line in lines if line in order] == order, name


def test_names_and_text_cannot_break_the_page() -> None:
    frame = pd.DataFrame({"a": [1]})
    parts = [Table("t", "<x1>", ["a_<x2>"], [["<x3>"]], frame), "<x4> and `<x5>`", Listing("<x6>", "<x7>")]
    page = html(Report("<x8>", "<x9>", ["<x10>"], [Section("s", "<x11>", list(parts))], "", "<x12>"))
    assert "<x" not in page
    assert {int(number) for number in re.findall(r"&lt;x(\d+)&gt;", page)} == set(range(1, 13))
    assert "<code>&lt;x5&gt;</code>" in page


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("stdy",), "did you mean study?"),
        (("empty",), "study 'empty' has no finished run (1 KILLED)"),
        (("study", "--metric", "training/return"), "'training/return' is not an evaluation metric"),
        (("study", "--metric", "retrun"), "did you mean evaluation_greedy/return?"),
        (("study", "--output", "FILE/report"), "--output: "),
        (("study", "--output", "FILE"), "--output: FILE is a file; name a folder"),
        (("study", "--format", "markdwon"), "invalid choice: 'markdwon'"),
    ],
)
def test_bad_input_is_one_line(
    words: tuple[str, ...], line: str, keep_run: Keep, root: Path, empty_folder: Path
) -> None:
    keep_run(TRACKING, 0, 1.0)
    keep_run(TRACKING, 0, 1.0, status="KILLED", study="empty")
    Path("FILE").write_text("")
    assert line in refused("report", *words, "--store", str(root))
    assert sorted(path.name for path in empty_folder.iterdir()) == ["FILE", "store"]


def test_the_only_evaluated_mode_is_the_default(keep_run: Keep, root: Path) -> None:
    keep_run((*TRACKING, "evaluation.modes=[sampled]"), 0, 1.0)
    with pytest.raises(HeadwayError, match="has no 'evaluation_sampled/return'"):
        StudyData(root, "study")


def test_a_metric_that_only_some_runs_have_is_not_suggested(keep_run: Keep, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0, wait=3.0)
    keep_run(TRACKING, 1, 1.0)
    with pytest.raises(HeadwayError, match=r"-s1-.* has no .*; did you mean .*/return\? Available: [^,]*$"):
        StudyData(root, "study", "evaluation_greedy/wait")


def test_error_on_different_evaluation_modes_says_how_to_train(keep_run: Keep, root: Path) -> None:
    keep_run((*TRACKING, "evaluation.modes=[greedy]"), 0, 1.0)
    keep_run((*TRACKING, "evaluation.modes=[sampled]"), 1, 1.0)
    line = r"no evaluation mode in common: .* train .* evaluation.modes=\[greedy\]$"
    with pytest.raises(HeadwayError, match=line):
        StudyData(root, "study")

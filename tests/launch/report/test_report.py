"""The page says what the store holds, and what it does not hold it says too."""

import csv
import io
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import pandas as pd
import pytest

from headway.contracts.errors import HeadwayError
from headway.stats import paired_difference_over_seeds
from headway.store import Status
from headway_launch.commands.main import run as run_command
from headway_launch.report.page import Report, html, write_report
from headway_launch.report.parts import Listing, Picture, Section, Table
from headway_launch.report.sections import report_of
from headway_launch.report.study_data import StudyData


class KeepRun(Protocol):
    """What the fixture is."""

    def __call__(
        self,
        overrides: Sequence[str],
        seed: int,
        final: float,
        status: Status = "FINISHED",
        study: str = "study",
        rules: Mapping[str, float] | None = None,
        energy: Mapping[str, Any] | None = None,
        points: int = 5,
        trained: Collection[int] | None = None,
        **metrics: float,
    ) -> Path: ...


TRACKING, MATRIX = ("experiment=toy_tracking",), ("experiment=toy_matrix",)
KNOWN = {
    "kwh": 3e-5,
    "kg_co2": 3e-6,
    "cpu_kwh": 2e-5,
    "gpu_kwh": None,
    "ram_kwh": 1e-5,
    "energy.cpu": "estimated (cpu_load, 8 W at full load)",
    "energy.gpu": "not measured",
    "energy.ram": "estimated (by size)",
}
RULES = {"random": -20.0, "optimal": 10.0}


def made(root: Path, study: str = "study", metric: str | None = None, lower: bool = False) -> Report:
    return report_of(StudyData(root, study, metric, lower))


def said(report: Report) -> str:
    """All its words."""
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


def names(report: Report) -> set[str]:
    """Of its tables and pictures."""
    parts = [part for section in report.sections for part in section.body]
    return {part.name for part in parts if isinstance(part, Table | Picture)}


def table(report: Report, name: str) -> pd.DataFrame:
    [found] = [part for section in report.sections for part in section.body if _is(part, name)]
    assert isinstance(found, Table)
    return found.data


def _is(part: object, name: str) -> bool:
    return isinstance(part, Table) and part.name == name


def two_algorithms(keep_run: KeepRun, **more: float) -> None:
    for seed in range(3):
        keep_run((*TRACKING, "algo=ippo"), seed, 5.0 + seed, rules=RULES, energy=KNOWN, **more)
        keep_run((*TRACKING, "algo=ia2c"), seed, 2.0 * seed, rules=RULES, energy=KNOWN, **more)


def test_both_forms_have_the_figures_of_the_store(keep_run: KeepRun, root: Path) -> None:
    two_algorithms(keep_run)
    report = made(root)
    published = table(report, "published_form").set_index("controller")
    ippo = published.loc["ippo"]
    assert [ippo[f"greedy_final_reward_{name}"] for name in ("mean", "std")] == [6.0, 1.0]
    assert ippo["training_final_reward_mean"] == 3.0
    # 0, half, 1, 1, 1 of the way up, at even steps; seed 0 of ia2c is flat, which is 0.5 by definition.
    assert ippo["greedy_auc_own_mean"] == pytest.approx(0.75)
    assert ippo["greedy_auc_study_mean"] == pytest.approx(0.75 * 6 / 7)
    assert published.loc["ia2c", "greedy_auc_own_mean"] == pytest.approx((0.5 + 2 * 0.75) / 3)
    assert published.loc["rule optimal", "greedy_final_reward_mean"] == 10.5  # days 0 and 1, as the curve
    assert "6.0 ± 1.0" in said(report)
    assert "but for those that change no result: where runs are kept" in said(report)

    sound = table(report, "sound_form").set_index("controller")
    learned = [[5.0 + seed + day for day in range(4)] for seed in range(3)]
    expected = paired_difference_over_seeds(learned, [[10.0 + day for day in range(4)]] * 3)
    found = [sound.loc["ippo", f"minus_best_rule{end}"] for end in ("", "_low", "_high")]
    assert found == pytest.approx([expected.estimate, expected.low, expected.high])
    assert sound.loc["rule random", "minus_best_rule"] == -30
    assert "no claim (worse)" in said(report)
    chances = table(report, "probability_of_improvement").set_index(["a", "b"])["probability"]
    assert chances["ippo", "ia2c"] == 1.0


def test_every_figure_at_the_top_names_its_days(keep_run: KeepRun, root: Path) -> None:
    two_algorithms(keep_run)
    report = made(root)
    best, against, *_ = report.summary
    assert best.endswith("the highest mean final reward: 6 over 3 seeds, on the curves' 2 days.")
    assert "`optimal`, on the last evaluation's 4 days [95% intervals]" in against
    assert "over seeds, on the curves' 2 days, the first of the last evaluation's 4 days; the" in said(report)
    configured = keep_run((*TRACKING, "algo=ippo"), 3, 5.0) / "config.yaml"
    configured.write_text(configured.read_text().replace("  episodes: 2\n", "  episodes: 3\n"))
    assert "the curves' days that differ" in made(root).summary[0]


def test_budgets_that_differ_by_rounding_are_said_beneath_the_tables(keep_run: KeepRun, root: Path) -> None:
    two_algorithms(keep_run)
    assert "the same environment steps" not in said(made(root))
    for seed in range(3):
        longer = keep_run((*TRACKING, "algo=coma"), seed, 1.0, rules=RULES, energy=KNOWN)
        record = json.loads((longer / "run.json").read_text())
        (longer / "run.json").write_text(json.dumps({**record, "durable_env_steps": 1048}))
    line = "coma 1,048, ia2c 40, ippo 40."
    assert said(made(root)).count(f"rounded up to whole iterations): {line}") == 2


def test_intervals_over_few_seeds_are_said_to_be_too_narrow(keep_run: KeepRun, root: Path) -> None:
    for seed in range(10):
        keep_run(TRACKING, seed, 5.0 + seed, study="enough")
    assert "too narrow" not in said(made(root, "enough"))
    for seed in range(2):
        keep_run((*TRACKING, "algo=ippo"), seed, 5.0 + seed)
        keep_run((*TRACKING, "algo=ia2c"), seed, 2.0 * seed)
    # Under both tables, and in the captions of both pictures with such intervals.
    assert said(made(root)).count("With fewer than 10 seeds the bootstrap's intervals are too narrow") == 4


def test_of_a_cell_that_diverged_the_captions_say_so(keep_run: KeepRun, root: Path) -> None:
    two_algorithms(keep_run)
    for seed in range(2):
        keep_run((*TRACKING, "algo=ddpg"), seed, -98_439.0 - seed)
    report = report_of(StudyData(root, "study", low=-30.0))
    assert "Beyond the axis: ddpg (at -98,440)." in said(report)
    pictures = {
        part.name: part.figure.axes[0]
        for section in report.sections
        for part in section.body
        if isinstance(part, Picture)
    }
    assert pictures["profiles"].get_xlim()[0] > -10
    assert pictures["learning_curves"].get_ylim()[0] == -30
    assert pictures["reward_against_energy"].get_ylim()[0] > -30


@pytest.mark.parametrize(("lower", "diverged"), [(False, False), (True, False), (True, True)])
def test_who_is_far_better_is_drawn(lower: bool, diverged: bool, keep_run: KeepRun, root: Path) -> None:
    two_algorithms(keep_run)
    sign = -1 if lower != diverged else 1
    for seed in range(2):
        keep_run((*TRACKING, "algo=ddpg"), seed, sign * 98_000.0, energy=KNOWN)
    report = report_of(StudyData(root, "study", lower_is_better=lower))
    assert ("Beyond the axis: ddpg" in said(report)) == diverged
    pictures = {
        part.name: part.figure.axes[0]
        for section in report.sections
        for part in section.body
        if isinstance(part, Picture)
    }
    for name in ("learning_curves", "intervals", "profiles", "reward_against_energy"):
        reach = [*pictures[name].get_xlim(), *pictures[name].get_ylim()]
        assert (max(map(abs, reach)) > 50_000) != diverged, name


def test_runs_of_few_evaluations_have_no_area_by_their_own_range(keep_run: KeepRun, root: Path) -> None:
    """Nor a half in the mean over seeds."""
    remark = "fewer than 3 points has no AUC by its own range"
    keep_run((*TRACKING, "algo=ippo"), 0, 1.0)
    assert remark not in said(made(root))
    keep_run((*TRACKING, "algo=ippo"), 1, 1.0, points=2)
    keep_run((*TRACKING, "algo=ia2c"), 0, 1.0, points=2)
    report = made(root)
    assert remark in said(report)
    assert "Such is the training curve of 2 runs (its points are iterations" in said(report)
    assert "and the greedy curve of 2 runs (its points are set by `evaluation.every`)." in said(report)
    published = table(report, "published_form").set_index("controller")
    areas = published[["training_auc_own_mean", "greedy_auc_own_mean"]]
    assert areas.loc["ippo"].tolist() == [pytest.approx(0.75)] * 2
    assert areas.loc["ia2c"].isna().all()
    assert published.loc["ia2c", "greedy_auc_study_mean"] == pytest.approx(0.25)


def test_training_columns_need_no_common_step(keep_run: KeepRun, root: Path) -> None:
    """Asynchronous workers end episodes at other updates in each run."""
    keep_run((*TRACKING, "algo=a3c"), 0, 4.0, rules=RULES, trained=(0, 2, 4))
    keep_run((*TRACKING, "algo=a3c"), 1, 8.0, rules=RULES, trained=(1, 3))
    report = made(root)
    a3c = table(report, "published_form").set_index("controller").loc["a3c"]
    assert a3c["training_final_reward_mean"] == 3.0  # half of 4 and of 8
    assert a3c["training_auc_own_mean"] == pytest.approx(0.75)  # of seed 0: seed 1 has but two points
    assert a3c["training_auc_study_mean"] == pytest.approx((0.75 * 2 / 4 + 0.75) / 2)
    assert "In 1 run no episode ended" not in said(report)
    short = "Such is the training curve of 1 run (its points are iterations in which episodes ended)."
    assert short in said(report)
    keep_run((*TRACKING, "algo=a3c"), 2, 100.0, rules=RULES, trained=())
    with_one_more = made(root)
    a3c = table(with_one_more, "published_form").set_index("controller").loc["a3c"]
    assert (a3c["seeds"], a3c["training_final_reward_mean"]) == (3, 3.0)
    assert "In 1 run no episode ended in training: the training columns are over the others." in said(
        with_one_more
    )
    assert short in said(with_one_more)  # one without a point has no curve


def test_training_columns_are_left_out_where_no_episode_ended(keep_run: KeepRun, root: Path) -> None:
    keep_run((*TRACKING, "algo=ippo"), 0, 4.0, rules=RULES, trained=())
    report = made(root)
    assert "There are no training columns: no episode ended in training." in said(report)
    [shown] = [part for section in report.sections for part in section.body if _is(part, "published_form")]
    assert isinstance(shown, Table)
    assert not [name for name in shown.headings if name.startswith("training")]
    assert {len(row) for row in shown.rows} == {len(shown.headings)} == {5}


def test_controllers_that_are_paid_by_different_rules_while_training_are_said(
    keep_run: KeepRun, root: Path
) -> None:
    remark = "Nor do the rows of the training columns compare with each other"
    own, alike = "env.training_args.reward.scope=own", "env.training_args.reward.scope=global"
    merge = ("env=merge",)
    keep_run((*merge, "algo=ippo", own), 0, 1.0)
    keep_run((*merge, "algo=ia2c", own), 0, 1.0)
    assert remark not in said(made(root))
    keep_run((*merge, "algo=coma"), 0, 1.0)
    keep_run((*merge, "algo=mappo", alike), 0, 1.0)  # as the environment has it by itself
    assert remark in (told := said(made(root)))
    assert "paid by the same rules: coma, mappo; ia2c, ippo." in told


def test_every_part_is_a_file_and_the_page_needs_none(keep_run: KeepRun, root: Path) -> None:
    two_algorithms(keep_run, reward_service=1.5, reward_regularity=-0.5)
    folder = root.parent / "report"
    assert run_command(["report", "study", "--store", str(root), "--output", str(folder)]) == 0
    page = (folder / "report.html").read_text()
    pictures = {path.stem for path in (folder / "pictures").iterdir()}
    assert {"learning_curves", "sample_efficiency", "profiles", "components", "footprint"} < pictures
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in (folder / "pictures").iterdir())
    assert page.count('<img src="data:image/svg+xml;base64,') == len(pictures)
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert len(list((folder / "configs").iterdir())) == 2
    for markdown in (folder / "tables").glob("*.md"):
        header, *rows = [line for line in markdown.read_text().splitlines() if line.startswith("|")]
        assert {line.count("|") for line in rows} == {header.count("|")}
    figures = list(csv.DictReader(io.StringIO((folder / "tables" / "figures.csv").read_text())))
    assert figures[-1]["ippo"] == "-0.5"


def test_energy_stands_beside_cpu_seconds(keep_run: KeepRun, root: Path) -> None:
    two_algorithms(keep_run)
    report = made(root)
    ippo = table(report, "energy").set_index("controller").loc["ippo"]
    assert (ippo["kwh"], ippo["cpu_seconds"]) == pytest.approx((3e-5, 4.0))
    assert math.isnan(ippo["gpu_kwh"])
    assert "mWh a run" in said(report)
    assert "CPU estimated (cpu_load, 8 W at full load); GPU not measured" in said(report)


@pytest.mark.parametrize("country", ["FRA", None])
def test_co2_stands_with_its_country_or_not_at_all(
    keep_run: KeepRun, root: Path, country: str | None
) -> None:
    chosen = (*TRACKING, f"energy.country={country or 'null'}")
    for seed in range(2):
        energy = {**KNOWN, "kg_co2": 3e-6 if country else None}
        keep_run(chosen, seed, 1.0, rules=RULES, energy=energy)
    report = made(root)
    assert "mWh a run" in said(report)
    assert ("CO2 with the energy mix of FRA" in said(report)) == (country is not None)
    assert ("no CO2, as no energy.country is set" in said(report)) == (country is None)
    assert ("mg CO2eq a run" in said(report)) == (country is not None)
    assert ("of CO2 equivalent" in said(report)) == (country is not None)


def test_co2_of_some_runs_of_a_cell_is_not_given_as_that_of_all(keep_run: KeepRun, root: Path) -> None:
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
    assert "1 run had no `energy.country`" in said(report)
    assert "of CO2 equivalent" not in said(report)


def test_energy_that_was_not_measured_is_not_zero(keep_run: KeepRun, root: Path) -> None:
    for seed in range(2):
        keep_run((*TRACKING, "energy=off"), seed, 1.0, rules=RULES)
    report = made(root)
    assert "Energy was not measured for these runs" in said(report)
    assert "their energy was not measured" in said(report)
    assert "CPU seconds stand in" in said(report)
    assert not {"energy", "footprint"} & names(report)


def test_some_runs_without_energy_are_said_and_left_out_of_its_means(keep_run: KeepRun, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0, energy=KNOWN)
    keep_run(TRACKING, 1, 1.0)
    report = made(root)
    assert "1 run had no measurement" in said(report)
    assert table(report, "energy")["runs"].tolist() == [1]
    # CPU seconds of the same run, 3, and not of both, 7.
    assert "Of 2 finished runs the 1 whose energy was measured used" in said(report)
    assert "(3 CPU seconds)" in said(report)


def test_one_seed_and_no_rule_are_said(keep_run: KeepRun, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0)
    report = made(root)
    assert "Of ippo there is one seed" in said(report)
    assert "No classical rule was played" in said(report)
    assert "There is one learner only" in said(report)
    assert "There is no performance profile" in said(report)
    assert not {"intervals", "profiles"} & names(report)


def test_runs_that_do_not_count_are_said_with_the_reason(keep_run: KeepRun, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0)
    keep_run(TRACKING, 1, 2.0, status="KILLED")
    failed = keep_run(TRACKING, 2, 3.0, status="FAILED")
    (failed / "traceback.txt").write_text("Traceback\n  somewhere\nValueError: NaN in layer 2\n")
    report = made(root)
    assert "Left out of all figures on this page: 2 not finished (1 FAILED, 1 KILLED)" in said(report)
    assert f"{failed.name} failed: ValueError: NaN in layer 2" in said(report)
    assert table(report, "runs")["counted"].tolist() == [True, False, False]


def test_environments_are_put_together_where_rules_give_them_a_scale(keep_run: KeepRun, root: Path) -> None:
    for seed in range(2):
        keep_run((*TRACKING, "algo=ippo"), seed, 10.5, rules=RULES)
        keep_run((*MATRIX, "algo=ippo"), seed, 2.0, rules={"random": 0.0, "optimal": 3.0})
        keep_run((*MATRIX, "algo=ia2c"), seed, 1.0, rules={"random": 0.0, "optimal": 3.0})
    report = made(root)
    assert report.subtitle == "tracking, matrix: 6 finished runs of 2 learners, and 2 classical rules"
    [row] = table(report, "across_environments").to_dict("records")
    # On the curves' days 0 and 1 tracking's rules have -19.5 and 10.5, matrix's 0.5 and 3.5.
    assert (row["controller"], row["mean"]) == ("ippo", pytest.approx((1 + 0.5) / 2))
    assert "Not trained on every environment, and so left out here: ia2c" in said(report)


def test_environments_without_a_scale_are_not_put_together(keep_run: KeepRun, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0, rules=RULES)
    keep_run(MATRIX, 0, 2.0, rules={"optimal": 3.0})
    report = made(root)
    assert "Scores cannot be put together: matrix has not both random play (0) and a rule" in said(report)
    assert "across_environments" not in names(report)


def test_days_that_differ_give_no_difference(keep_run: KeepRun, root: Path) -> None:
    keep_run((*TRACKING, "algo=ippo"), 0, 1.0, rules=RULES)
    keep_run((*TRACKING, "algo=ia2c", "evaluation.seed=5"), 0, 1.0, rules=RULES)
    assert "best rule is given on tracking: the cells were evaluated on different days" in said(made(root))


def test_one_day_gives_no_difference(keep_run: KeepRun, root: Path) -> None:
    folder = keep_run(TRACKING, 0, 1.0, rules=RULES)
    [played] = folder.parent.glob("*.rules.json")
    played.write_text(json.dumps({rule: days[:1] for rule, days in json.loads(played.read_text()).items()}))
    line = "The best rule on tracking is `optimal`; how far learners are from it is not known: fewer than two"
    assert line in said(made(root))


def test_another_reward_in_training_is_said(keep_run: KeepRun, root: Path) -> None:
    keep_run((*TRACKING, "env.training_args={effort: 0.5}"), 0, 1.0)
    assert "the training columns are of that reward and do not compare" in said(made(root))


def test_a_cost_is_better_the_lower(keep_run: KeepRun, root: Path) -> None:
    for seed in range(2):
        keep_run((*TRACKING, "algo=ippo"), seed, 1.0, rules=RULES, wait=2.0)
        keep_run((*TRACKING, "algo=ia2c"), seed, 9.0, rules=RULES, wait=7.0)
    report = made(root, metric="evaluation_greedy/wait", lower=True)
    assert "ippo has the lowest mean final wait: 2 over 2 seeds" in said(report)
    assert "training: final wait" not in said(report)
    assert "training: final reward" in said(report)
    chances = table(report, "probability_of_improvement").set_index("a")["probability"]
    assert chances["ippo"] == 1


def test_names_and_text_cannot_break_the_page() -> None:
    frame = pd.DataFrame({"a": [1]})
    parts = [Table("t", "<x1>", ["a_<x2>"], [["<x3>"]], frame), "<x4> and `<x5>`", Listing("<x6>", "<x7>")]
    page = html(Report("<x8>", "<x9>", ["<x10>"], [Section("s", "<x11>", list(parts))], "<x12>"))
    assert "<x" not in page
    assert {int(number) for number in re.findall(r"&lt;x(\d+)&gt;", page)} == set(range(1, 13))
    assert "<code>&lt;x5&gt;</code>" in page


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("stdy",), "there is no study 'stdy' in"),
        (("stdy",), "did you mean study?"),
        (("empty",), "study 'empty' has no finished run (1 KILLED)"),
        (("study", "--metric", "training/return"), "'training/return' is no metric of evaluation"),
        (("study", "--metric", "evaluation_greedy/retrun"), "did you mean evaluation_greedy/return?"),
        (("study", "--output", "FILE"), "--output: "),
        (("study", "--output", "FILE/report"), "--output: "),
    ],
)
def test_bad_input_is_one_line(
    words: tuple[str, ...],
    line: str,
    keep_run: KeepRun,
    root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    keep_run(TRACKING, 0, 1.0)
    keep_run(TRACKING, 0, 1.0, status="KILLED", study="empty")
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("")
    assert run_command(["report", *words, "--store", str(root)]) == 2
    told = capsys.readouterr().err
    assert told.startswith("headway: ")
    assert line in told
    assert told.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["FILE", "store"]


def test_of_evaluation_in_another_mode_that_is_taken(keep_run: KeepRun, root: Path) -> None:
    directory = keep_run((*TRACKING, "evaluation.modes=[sampled]"), 0, 1.0)
    assert directory.exists()
    with pytest.raises(HeadwayError, match="has no 'evaluation_sampled/return'"):
        StudyData(root, "study")


def test_a_metric_that_only_some_runs_have_is_not_suggested(keep_run: KeepRun, root: Path) -> None:
    keep_run(TRACKING, 0, 1.0, wait=3.0)
    keep_run(TRACKING, 1, 1.0)
    with pytest.raises(HeadwayError, match=r"-s1-.* has no .*; did you mean .*/return\? Available: [^,]*$"):
        StudyData(root, "study", "evaluation_greedy/wait")


def test_runs_evaluated_in_different_modes_are_told_what_to_train_with(keep_run: KeepRun, root: Path) -> None:
    keep_run((*TRACKING, "evaluation.modes=[greedy]"), 0, 1.0)
    keep_run((*TRACKING, "evaluation.modes=[sampled]"), 1, 1.0)
    with pytest.raises(HeadwayError, match=r"no curve is of all; train .* evaluation.modes=\[greedy\]$"):
        StudyData(root, "study")


def test_files_of_an_earlier_report_are_told(
    keep_run: KeepRun, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two_algorithms(keep_run)
    write_report(made(root), tmp_path / "report")
    assert "not of this report" not in capsys.readouterr().err
    (tmp_path / "report" / "tables" / "scaling.md").write_text("of before")
    write_report(made(root), tmp_path / "report")
    assert "still in" in (told := capsys.readouterr().err)
    assert "tables/scaling.md" in told
    assert told.count("\n") == 1

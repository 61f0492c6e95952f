"""`headway data`: what each command says, writes and refuses."""

import csv
import json
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import failed, output, refused, rows_of

from headway_envs.bus.config import BusConfig
from headway_envs.bus.prepare import prepare
from headway_envs.bus.scenario import description
from headway_envs.bus.scenario.fitted import DOI
from headway_envs.bus.scenario.tables import read_tables
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose

PROJECT = Path(__file__).parents[4]
GUIDE = PROJECT / "docs" / "howto" / "scenario.md"
PARTS = ("synthetic", "gtfs", "csv", "sunt", "describe", "plot", "realism")
HEAVY = ("pandas", "pyarrow", "numba", "scipy", "matplotlib")


def test_every_help_shows_examples_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from headway_launch.commands.main import run; run(['data']); "
        f"[run(['data', part, '--help']) for part in {PARTS}]; "
        f"print([name for name in {HEAVY} if name in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    for part in PARTS:
        assert f"\n  {part} " in shown
        assert f"usage: headway data {part}" in shown
        assert f"examples:\n  headway data {part} " in shown
    assert shown.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["synthetc"], ["unknown command 'synthetc' of headway data", "headway data synthetic"]),
        (["synthetic"], ["OUT", "headway data synthetic --help"]),
        (["synthetic", "x", "--seed", "-1"], ["--seed must be at least 0"]),
        (
            ["describe", "nowhere"],
            [
                "scenario 'nowhere' is none of line, corridor, district, city",
                "/nowhere is not a folder (a scenario",
            ],
        ),
        (["plot", "line", "--output", "x.nothing"], ["--output: x.nothing cannot be written"]),
        (["plot", "line", "--output", "x"], ["--output: x has no suffix", "as x.png or .svg"]),
        (["plot", "line", "--output", "no/x.png"], ["--output: no/x.png cannot", "there is no folder no;"]),
        (["plot", "line", "--day-type", "monday"], ["--day-type", "monday"]),
        (["gtfs", "nowhere.zip", "x"], ["nowhere.zip does not exist; give a GTFS feed"]),
        (["gtfs", "f", "x", "--weekday", "soon"], ["--weekday: 'soon' is not a date YYYY-MM-DD"]),
        (["gtfs", "f", "x", "--boardings-per-trip", "0"], ["--boardings-per-trip must be above 0"]),
        (["csv", "nowhere", "x"], ["nowhere is not a folder; give the one that holds stops.csv"]),
        (["sunt", "nowhere", "x"], ["nowhere is not a folder"]),
        (["sunt", "f", "x", "--sunday", "0"], ["--sunday: '0' is not a date"]),
        (["describe", "corridr"], ["did you mean 'corridor'?"]),
        (["describe", "line", "--seed", "-1"], ["--seed must be at least 0, not -1"]),
        (["plot", "line", "--seed", "-1"], ["--seed must be at least 0, not -1"]),
        (["describe", "line", "--lines", "-2"], ["--lines must be at least 0, not -2"]),
        (["describe", "line", "--stops", "-2"], ["--stops must be at least 0, not -2"]),
        (["realism", "nowhere"], ["there is no folder nowhere"]),
        (["realism", "line"], ["the scenario's trips are made up, so there are no measurements; give"]),
        (["realism", "line", "--days", "0"], ["--days must be at least 1"]),
        (["realism", "line", "algo.lr=3"], ["algo.lr: only env.args.* of the bus environment"]),
        (["realism", "line", "env.args.day_type=sunday"], ["env.args.day_type: give --day-type"]),
        (["realism", "line", "env.args.noise={dispatch_s: 9}"], ["fixes noise.dispatch_s; give the other"]),
        (["realism", "line", "env.args.boardin_s=3"], ["did you mean env.args.boarding_s?"]),
    ],
)
def test_errors_are_one_line_with_the_fix(arguments: list[str], parts: list[str]) -> None:
    line = refused("data", *arguments)
    assert all(part in line for part in parts), line


@pytest.mark.parametrize(
    "setting",
    [
        "scenario_seed=1", "start_hour=6", "end_hour=20", "recovery_share=1", "dispatch_window_s=9",
        "noise.dispatch_s=9", "upkeep.uptime_hours=9",
    ],
)  # fmt: skip
def test_keys_that_a_replay_fixes_are_refused(setting: str) -> None:
    key = setting.partition("=")[0]
    line = refused("data", "realism", "line", f"env.args.{setting}")
    assert f"env.args.{key}: a replay fixes this key; omit it" in line


def test_a_written_scenario_is_the_built_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "towns" / "mine"
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    shown, told = output("data", "synthetic", str(out), "--size", "line", "--seed", "5")
    assert "lines with a timetable: 1 of 1" in told
    assert "day types described: 2 of 2" in told
    assert "of 1" not in shown
    assert "1 line, 2 patterns" in shown
    assert f"env.args.scenario={out}" in shown
    assert json.loads((out / "meta.json").read_text())["seed"] == 5
    assert sorted(file.name for file in out.parent.iterdir()) == ["mine"]
    there, here = prepare(BusConfig(scenario=str(out))), prepare(BusConfig(scenario_seed=5))
    for mine, theirs in zip(here.network, there.network, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_an_operator_s_files_become_a_scenario_or_nothing_is_written(tmp_path: Path) -> None:
    folder, out = tmp_path / "counts", tmp_path / "mine"
    folder.mkdir()
    for name, text in _files_of_the_guide().items():
        (folder / f"{name}.csv").write_text(text, encoding="utf-8")
    page = GUIDE.read_text(encoding="utf-8")
    times = folder / "link_times.csv"
    intact = times.read_text(encoding="utf-8")
    times.write_text(intact.replace("165", "2:45"), encoding="utf-8")
    line = refused("data", "csv", str(folder), str(out))
    assert "link_times.csv, row 2, column mean_s: '2:45' is not a number; correct it" in line
    assert not out.exists()
    times.write_text(intact, encoding="utf-8")
    shown = output("data", "csv", str(folder), str(out)).out
    assert "1 line, 2 patterns, 3 stops, 4 links\nweekday: 8 trips" in shown
    assert "service: 07:00 to 08:06, whereas 05:00 to 24:00 is simulated by default" in shown
    hours = "env.args.start_hour=7 env.args.end_hour=9"
    assert shown.splitlines()[-1].endswith(f"env.args.scenario={out} {hours}")
    assert hours in page
    prepared = prepare(BusConfig(scenario=str(out)))
    assert prepared.network.pattern_calls.tolist() == [0, 3, 6]
    assert "no trip leaves after 8.0 h" in prepared.notices[0]
    assert prepare(BusConfig(scenario=str(out), start_hour=7, end_hour=9)).notices == ()


def test_the_realism_of_a_few_recorded_calls_has_blanks_and_a_caution(tmp_path: Path) -> None:
    folder, out = tmp_path / "recorded", tmp_path / "mine"
    folder.mkdir()
    page = GUIDE.read_text(encoding="utf-8")
    [calls] = re.findall(r"```text\n(date,.*?)```", page, re.DOTALL)
    for name, text in {**_files_of_the_guide(), "calls": calls}.items():
        if name in ("stops", "lines", "calls"):
            (folder / f"{name}.csv").write_text(text, encoding="utf-8")
    assert run(["data", "csv", str(folder), str(out)]) == 0
    shown = output("data", "realism", str(out), "--records", str(folder), "--days", "2").out
    assert "\nnan" not in shown.replace("\t", "\n")
    assert "1 trip per day: too few to compare" in shown


def test_a_scenario_of_sundays_alone_is_run_on_sundays(tmp_path: Path) -> None:
    for name, text in _files_of_the_guide().items():
        lines = text.splitlines()
        if name in ("trips", "link_times", "demand"):
            lines = [f"day_type,{lines[0]}", *(f"sunday,{line}" for line in lines[1:])]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines), encoding="utf-8")
    out = tmp_path / "mine"
    train = output("data", "csv", str(tmp_path), str(out)).out.splitlines()[-1].split("; ")[1]
    assert train.endswith(" env.args.day_type=sunday env.args.start_hour=7 env.args.end_hour=9")
    assert compose(train.removeprefix("headway run ").split()).env_config.day_type == "sunday"
    shown = output("data", "describe", str(out)).out.splitlines()
    assert "quantity per day\tsunday" in shown
    assert "last arrival\t08:06" in shown
    assert "headway 17:00-19:00, min\tfewer than 2 departures" in shown
    assert "headway 06:00-08:00, min\t15" in shown  # the service begins and ends within these hours
    numbers = [line.split("\t")[:2] for line in shown[shown.index("stop\tname\tlines\tboardings") + 1 :]]
    stops = read_tables(out).stops
    assert sorted(numbers) == [[str(row.stop), row.name] for row in stops.itertuples(index=False)]


def _files_of_the_guide() -> dict[str, str]:
    """Return the CSV files of the guide's example with counts, by name."""
    page = GUIDE.read_text(encoding="utf-8")
    files = dict(re.findall(r"`(\w+)\.csv`:\n\n```text\n(.*?)```", page, re.DOTALL))
    return {name: text for name, text in files.items() if name != "calls"}


@pytest.mark.parametrize(
    ("buses", "like"),
    [
        (14, ("env=bus", "algo=mappo", "preset=bus_tuned")),
        (110, ("experiment=bus_network",)),
        (1360, ("experiment=bus_city",)),
    ],
    ids=["line", "corridor", "city"],
)
def test_the_recommended_command_has_the_settings_of_the_study_of_such_networks(
    buses: int, like: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All sizes that `headway data synthetic --help` lists are tested; the generated town is a line."""
    described = description.by_day_type

    def by_day_type(*arguments: Any) -> list[description.DayStatistics]:  # noqa: ANN401 - passed on
        return [replace(day, peak_buses=buses) for day in described(*arguments)]

    monkeypatch.setattr(description, "by_day_type", by_day_type)
    out = tmp_path / "my line"
    last = output("data", "synthetic", str(out)).out.splitlines()[-1]
    describe, train = last.removeprefix("next: ").split("; ")
    assert shlex.split(describe) == ["headway", "data", "describe", str(out)]
    experiment = compose(shlex.split(train.removeprefix("headway run ")))
    assert experiment.env_config.scenario == str(out)
    study = compose(like)
    assert (experiment.algo_name, experiment.algo_config) == (study.algo_name, study.algo_config)
    assert experiment.config.rollout == study.config.rollout
    assert experiment.training_env_configs[0].reward == study.training_env_configs[0].reward


def test_the_guide_goes_on_with_the_printed_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = (PROJECT / "docs" / "guide" / "everyday_use.md").read_text(encoding="utf-8").splitlines()
    commands = [line.split("#")[0].strip() for line in lines if line.startswith("    headway ")]
    [create] = [place for place, command in enumerate(commands) if " data synthetic " in command]
    monkeypatch.chdir(tmp_path)
    last = output(*commands[create].split()[1:]).out.splitlines()[-1]
    assert set(last.removeprefix("next: ").split("; ")) <= set(commands[create + 1 :])


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "mine"
    assert run(["data", "synthetic", str(out)]) == 0
    again = ["data", "synthetic", str(out), "--seed", "1"]
    assert "holds a scenario; --replace overwrites it" in refused(*again)
    assert json.loads((out / "meta.json").read_text())["seed"] == 0
    assert run([*again, "--replace"]) == 0
    assert json.loads((out / "meta.json").read_text())["seed"] == 1
    (tmp_path / "notes.txt").write_text("mine")
    assert "holds other files" in refused("data", "synthetic", str(tmp_path), "--replace")
    assert "is a file" in refused("data", "synthetic", str(tmp_path / "notes.txt"))


@pytest.mark.parametrize("other", ["src/a.py", "notes.txt"])
def test_a_folder_that_holds_more_than_a_scenario_is_never_replaced(other: str, tmp_path: Path) -> None:
    project = tmp_path / "project"
    assert run(["data", "synthetic", str(project)]) == 0
    mine = project / other
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    line = refused("data", "synthetic", str(project), "--seed", "1", "--replace")
    assert f"holds other files ({other.split('/')[0]}); name a new folder" in line
    assert mine.read_text() == "mine"
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "meta.json").write_text("mine")
    refused("data", "synthetic", str(alone), "--replace")
    assert (alone / "meta.json").read_text() == "mine"


def test_the_old_scenario_returns_if_the_new_one_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "mine"
    assert run(["data", "synthetic", str(out)]) == 0
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise OSError("no room")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    line = refused("data", "synthetic", str(out), "--seed", "1", "--replace")
    assert "cannot be written (no room)" in line
    assert json.loads((out / "meta.json").read_text())["seed"] == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("out", ["city", "./line/"])
def test_a_folder_that_could_not_be_named_to_the_environment_is_refused(out: str, empty_folder: Path) -> None:
    name = Path(out).name
    line = refused("data", "synthetic", out)
    assert f"env.args.scenario={name} selects the built-in scenario; choose" in line
    assert not list(empty_folder.iterdir())
    assert run(["data", "synthetic", f"towns/{name}"]) == 0


def test_the_working_directory_and_those_above_are_refused_before_any_work(empty_folder: Path) -> None:
    for out in (".", "", "..", "towns/..", str(empty_folder)):
        line = refused("data", "gtfs", "no feed", out)
        assert "is the working directory or one of its parents; name a folder in it" in line


def test_a_link_to_a_scenario_stays_one_and_names_the_new_one(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    for seed in ("0", "1"):
        assert run(["data", "synthetic", str(tmp_path / "link"), "--seed", seed, "--replace"]) == 0
        assert json.loads((tmp_path / "mine" / "meta.json").read_text())["seed"] == int(seed)
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize(
    ("size", "lines", "slots", "named"),
    [("line", 1, 14, 1), pytest.param("corridor", 10, 110, 3, marks=pytest.mark.slow)],
)
def test_descriptions_count_what_the_environment_runs(size: str, lines: int, slots: int, named: int) -> None:
    rows = rows_of("data", "describe", size, "--lines", "3", "--day-type", "weekday")
    values = {row[0]: row[1:] for row in rows}
    assert values["lines"] == [str(lines)]
    assert values["agents (slots), 05:00-24:00"][0] == str(slots)
    assert values["first departure"][0] == "05:00"
    assert values["busiest hour"][0] == "06:00-07:00"
    assert values["link_times_include_dwell"] == ["True"]
    listed = [row for row in rows if row[0].startswith("line") and len(row) == 9]
    assert len(listed) == named + 1  # and the names of the columns
    trips = [int(row[4]) for row in listed[1:]]
    assert trips == sorted(trips, reverse=True)


def test_realism_prints_simulated_beside_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "recorded"
    assert run(["data", "synthetic", str(out)]) == 0
    (out / "meta.json").write_text('{"source": "records of a test"}')
    realism = ("data", "realism", str(out), "--days", "1")
    header, *rows = csv.reader(output(*realism, "--format", "csv").out.splitlines())
    assert header[0] == "statistic"
    first = dict(zip(header, next(row for row in rows if row[0] == "headway CV, first call"), strict=True))
    assert first["simulated"] == first["measured"]
    assert first["verdict"] == "within tolerance"
    assert first["measured in"] == "its own tables"
    assert output(*realism, "--day-type", "sunday").out.endswith(" statistics are within tolerance\n")
    (out / "meta.json").write_text(json.dumps({"source": f"records of a test of doi:{DOI}"}))
    *rows, counted, left_out = output(*realism).out.splitlines()
    cells = [row.split("\t") for row in rows[1:]]
    own = [row for row in cells if row[7] == "its own tables"]
    assert {row[6] for row in cells if row not in own} == {"not judged"}
    within = sum(row[6] == "within tolerance" for row in own)
    assert counted == f"{within} of {len(own)} statistics are within tolerance"
    assert left_out.startswith(f"not judged: {len(cells) - len(own)} statistics measured over all 382")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    told = failed(*realism, "--records", str(tmp_path))
    assert "days simulated: 0 of 1" in told
    assert "there is no file od-YYYY-MM-DD.parquet below" in told

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import numpy as np
import pytest
from command_lines import output, refused, rows_of

from headway.config.schema import describe
from headway.registry import env_entries, env_entry
from headway_launch.commands import compare, evaluate, main
from headway_launch.commands.listing import KINDS
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--config-dir", "lab", "list"], ["--config-dir comes before the command; write headway COMMAND"]),
        (["rnu"], ["unknown command 'rnu'", "did you mean headway run?"]),
        (["list", "experimens"], ["did you mean headway list experiments?"]),
        (["list", "environments"], ["did you mean headway list envs?"]),
        (["list", "environment"], ["did you mean headway list envs?"]),
        (["list", "algorithm"], ["did you mean headway list algos?"]),
        (["list", "envs", "trivail"], ["did you mean trivial?"]),
        (["list", "algos", "mapo"], ["did you mean mappo?"]),
        (["list", "experiments", "bus_mapo"], ["did you mean bus_mappo?"]),
        (["list", "searches", "bus_lin"], ["did you mean bus_line?"]),
        (["list", "metrics", "mpe2.simple_spread_v3"], ["its EnvEntry `metrics`", "that do: bus, "]),
        (["list", "metrics", "buss"], ["buss", "bus"]),
        (["list", "observaitons"], ["did you mean headway list observations?"]),
        (["run", "experiment=a", "experiment=b"], ["experiment=a and experiment=b are several experiments"]),
        (["evaluate", "s0", "--episodes", "x"], ["headway: --episodes x: give a whole number"]),
        (["run", "--fast"], ["--fast", "headway run --help"]),
        (["run", "--dryrun"], ["--dryrun; did you mean --dry-run? See headway run --help"]),
        (["run", "env=bus", "--seed", "3"], ["unrecognized arguments: --seed 3; write seed=3"]),
        (["run", "--algo", "ippo"], ["--algo; write algo=ippo"]),
        (["sweep", "--env", "bus", "algo=ippo"], ["--env; write env=bus"]),
        (["run", "env=bus", "--env-steps=1e6"], ["--env-steps=1e6; write env_steps=1e6"]),
        (["run", "env=bus", "--algo.lr", "--dry-run"], ["--algo.lr; write algo.lr=VALUE"]),
        (["search", "toy_matrix", "--study", "x"], ["--study x; write study=x"]),
        (["run", "--wat", "3"], ["--wat; see headway run --help"]),
        (["compare", "bus", "--baseline", "x"], ["--baseline x; see headway compare --help"]),
        (["compare", "bus", "--seeds", "3"], ["--seeds 3; did you mean --seed? See headway compare --help"]),
        (["run", "env=trivial", "--store", "here"], ["headway run takes store.root=here"]),
        (["list", "envs", "--store", "here"], ["--store here; see headway list --help"]),
        (["data", "plot", "here", "store.root=x"], ["store.root=x; see headway data plot --help"]),
        (["runs", "store.root=here"], ["headway runs takes --store here"]),
        (["list", "observations", "bus", "env=merge"], ["env=bus and env=merge set the same key"]),
        (["compare", "env=bus", "env=merge"], ["env=bus and env=merge set the same key"]),
        (["render", "bus", "--rule", "idle", "env=merge"], ["env=bus and env=merge set the same key"]),
        (["runs", "--store", "nowhere"], ["there is no store in 'nowhere'"]),
        (["resume", "--store", "."], ["name a run or --study"]),
        (["resume", "s0", "algo.lr=3"], ["algo.lr=3: a run continues with its own configuration; omit this"]),
        (["render"], ["required: RUN|ENV; see headway render --help"]),
    ],
)
def test_errors_are_one_line_with_the_fix_and_exit_code_2(arguments: list[str], parts: list[str]) -> None:
    line = refused(*arguments)
    assert all(part in line for part in parts), line


@pytest.mark.parametrize(
    "command", ["run", "sweep", "resume", "runs", "evaluate", "compare", "plot", "report", "browse", "list"]
)
def test_every_help_shows_examples(command: str) -> None:
    shown = output(command, "--help").out
    assert f"usage: headway {command}" in shown
    assert "examples:" in shown


@pytest.mark.parametrize("command", ["archive", "convert", "data plot", "export", "plot", "render", "report"])
def test_every_command_that_writes_a_file_takes_o(command: str) -> None:
    assert re.search(r"^  -o [A-Z]+, --output ", output(*command.split(), "--help").out, re.MULTILINE)


_HELP = """
import sys
before = set(sys.modules)
from headway_launch.commands.main import run
assert run(["--help"]) == 0
imported = {name.partition(".")[0] for name in set(sys.modules) - before}
of_numpy = {name for name in imported if name.startswith(("_", "cython_"))}
print("imported:", *sorted(imported - of_numpy - sys.stdlib_module_names))
"""


def test_help_imports_numpy_alone() -> None:
    """Other third-party packages are not imported, so that help is quick."""
    shown = subprocess.run([sys.executable, "-c", _HELP], capture_output=True, text=True, check=True).stdout
    assert "headway run" in shown
    assert shown.splitlines()[-1] == "imported: headway headway_launch numpy"


def test_the_summary_of_list_names_every_kind() -> None:
    summary = main.COMMANDS["list"].summary
    assert [kind for kind in KINDS if kind not in summary and kind.removesuffix("s") not in summary] == []


def test_keys_of_an_algorithm_are_listed_with_the_rollout_that_it_brings() -> None:
    header, *rows = rows_of("list", "algos", "a3c")
    assert header == ["key", "type", "default", "description"]
    assert any(row[:2] == ["algo.lr", "number"] for row in rows)
    assert [row[2] for row in rows if row[0].startswith("rollout.")] == ["8", "32", "2"]


def test_control_characters_are_shown_as_escapes() -> None:
    """Terminal commands, marks of the writing direction, and bytes that are not text."""
    assert r"algo=\x1b[31m\u202emappo\udcff" in refused("run", "algo=\x1b[31m\u202emappo\udcff")


def test_debug_shows_the_traceback() -> None:
    with pytest.raises(Exception, match="unknown command"):
        run(["--debug", "rnu"])


def test_an_empty_store_has_no_runs(tmp_path: Path) -> None:
    assert json.loads(output("runs", "--store", str(tmp_path), "--format", "json").out) == []


@pytest.mark.parametrize("command", [compare, evaluate], ids=["compare", "evaluate"])
def test_examples_name_existing_rules(command: ModuleType) -> None:
    """The rules are those of the environment that an example gives, else of the buses."""
    examples = re.findall(r"^ +headway .*--(?:rules|against) .*$", command.EXAMPLES, re.MULTILINE)
    assert examples
    for example in examples:
        given = re.findall(r"(?:env|experiment)=\S+", example)
        there = compose(given).env.rules if given else env_entry("bus").rules
        named = re.findall(r"--(?:rules|against) (\S+)", example)
        assert {rule for names in named for rule in names.split(",")} <= set(there), example


def test_environments_that_a_file_makes_of_others_are_listed() -> None:
    """All that `env=` takes by name."""
    rules = {name: own for name, _, own in rows_of("list", "envs")}
    assert "virtual_signal_0.5" in rules["intersection"]
    assert rules["intersection_paper"] == rules["intersection"]
    assert "id: intersection\n" in output("list", "envs", "intersection_paper").out


def test_a_command_whose_reader_has_gone_ends_quietly() -> None:
    command = [sys.executable, "-m", "headway_launch", "list", "algos"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        said = process.stderr.read()
    assert process.returncode == 0
    assert said == ""


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("runs", 0), ("data describe x", 0), ("run --help", 0), ("sweep algo=a,b --dry-run", 0),
        ("run algo=a", 2),
    ],
)  # fmt: skip
def test_only_training_commands_fail_if_their_reader_has_gone(
    words: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed_pipe(words: list[str], debug: bool, typed: bool) -> NoReturn:
        raise BrokenPipeError

    monkeypatch.setattr(main, "_dispatch", closed_pipe)
    monkeypatch.setattr(main, "silence", lambda stream: None)
    assert run(words.split()) == code


@pytest.mark.parametrize("given", [None, 0, 3, "I am off"])
def test_an_environments_exit_is_an_error(given: int | str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    def leave(words: list[str], debug: bool, typed: bool) -> NoReturn:
        sys.exit(given)

    monkeypatch.setattr(main, "_dispatch", leave)
    told = f"headway: the environment's code called sys.exit({given!r}); raise an error"
    assert refused("run", "env=zoo.street").startswith(told)


def test_the_help_of_realism_offers_no_scenario_that_it_refuses() -> None:
    shown = " ".join(output("data", "realism", "--help").out.split())
    assert "folder with recorded trips" in shown
    assert "--seed" not in shown
    assert "corridor" not in shown


@pytest.mark.parametrize("name", env_entries())
def test_what_metrics_are_is_listed_for_each_of_an_episode(name: str) -> None:
    header, *rows = rows_of("list", "metrics", name)
    assert header == ["environment", "metric", "description"]
    entry = env_entry(name)
    with closing(entry.make(entry.prepare(entry.config()), 1)) as env:
        assert [row[1] for row in rows] == ["length", "return", *env.spec.metrics]
    assert all(row[0] == name and row[2] for row in rows)
    known = {description.key for description in describe(entry.config, "env.args")}
    named = {key for what in entry.metrics.values() for key in re.findall(r"env\.args(?:\.\w+)+", what)}
    assert named <= known


def test_every_rule_has_a_distinct_description() -> None:
    """No other rule of the same environment has the same line."""
    header, *rows = rows_of("list", "rules")
    assert header == ["environment", "rule", "description"]
    listed = [(name, rule) for name, rule, _ in rows]
    registered = [
        (name, rule)
        for name, entry in env_entries().items()
        for rule in (*entry.rules, *(["lookahead"] if entry.lookahead else []))
    ]
    assert listed[: len(registered)] == registered
    assert ("intersection_paper", "reservation") in listed[len(registered) :]
    assert all(len(what.split()) > 1 and len(what) <= 110 for _, _, what in rows)
    assert len({(name, what) for name, _, what in rows}) == len(rows)
    of_bus = rows_of("list", "rules", "bus")
    assert of_bus == [header, *(row for row in rows if row[0] == "bus")]
    assert "under 0.7 of the target" in dict(row[1:] for row in of_bus)["headway_holding_0.7"]


def test_an_environment_of_a_module_has_the_rule_random() -> None:
    assert [row[1] for row in rows_of("list", "rules", "mpe2.simple_spread_v3")] == ["rule", "random"]
    refused("list", "rules", "buss")


@pytest.mark.parametrize("what", ["envs", "metrics", "rules"])
def test_suggestions_for_a_wrong_name_include_environments_from_files(what: str) -> None:
    assert "did you mean intersection_paper?" in refused("list", what, "intersection_papr")


@pytest.mark.parametrize("what", ["metrics", "rules"])
def test_metrics_and_rules_are_also_listed_for_configuration_files(what: str) -> None:
    own, configured = (rows_of("list", what, name) for name in ("intersection", "intersection_paper"))
    assert len(own) > 5
    assert [row[1:] for row in own] == [row[1:] for row in configured]


@pytest.mark.parametrize(
    ("allocate", "text"),
    [
        (lambda arguments: [None] * 2**62, "memory than is free; lower"),
        (lambda arguments: np.empty(2**59), "memory than is free (Unable to allocate 4.00 EiB"),
    ],
)
def test_a_lack_of_memory_is_one_line_that_says_what_to_lower(
    allocate: Callable[[object], object], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("headway_launch.commands.runs.execute", allocate)
    line = refused("runs")
    assert text in line
    assert "rollout.copies" in line


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ("**kwargs", "does not list its arguments: any env.args.KEY=VALUE is passed on to it"),
        ("", "takes no arguments"),
    ],
)
def test_an_environment_without_listed_arguments_says_why(parameters: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "quay.py"
    file.write_text(f"def parallel_env({parameters}):\n    raise NotImplementedError\n")
    assert output("list", "envs", str(file)).err == f"{file} {says}\n"


def test_a_second_experiment_is_refused_without_a_notice(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["run", "experiment=a", "experiment=b"], typed=True) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_word_that_replaces_another_is_named_if_a_user_typed_it(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "env=trivail", "seed=0", "algo.lr=1", "seed=0", "++algo.lr=3"]
    assert run(words, typed=True) == 2
    assert "headway: ++algo.lr=3 replaces algo.lr=1\n" in (typed := capsys.readouterr().err)
    assert run(words) == 2
    assert capsys.readouterr().err == typed.replace("headway: ++algo.lr=3 replaces algo.lr=1\n", "")


def test_sigterm_ends_a_command_as_ctrl_c_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    monkeypatch.setattr(main, "_dispatch", lambda *_: signal.raise_signal(signal.SIGTERM))
    try:
        with pytest.raises(SystemExit, match="130"):
            main.main()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == "headway: stopped\n"

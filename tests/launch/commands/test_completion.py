"""Completion of command lines: what shells propose, and what computing it imports."""

import os
import subprocess
import sys
from pathlib import Path

import argcomplete
import pytest
from stored_runs import keep_run

from headway_launch.commands.completion import override_completions
from headway_launch.commands.main import COMMANDS
from headway_launch.experiments.compose import compose
from headway_launch.experiments.options import options

COMPLETE = """\
import os, sys
def leave(code):
    heavy = [name for name in ("torch", "mlflow", "hydra", "pandas") if name in sys.modules]
    sys.exit(f"imports {heavy}" if heavy else code)
os._exit = leave
from headway_launch.commands.main import main
main()
"""


def completions(line: str, folder: Path) -> list[str]:
    """Return what is proposed at the end of a line. Fails if a heavy module is imported for it."""
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(folder / "proposed"),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    done = subprocess.run(
        [sys.executable, "-c", COMPLETE],
        env={**os.environ, **asked},
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return [word.strip() for word in (folder / "proposed").read_text().splitlines()]


def test_commands_and_their_options_are_completed(tmp_path: Path) -> None:
    assert {*COMMANDS, "--version"} <= set(completions("headway ", tmp_path))
    assert completions("headway data re", tmp_path) == ["realism"]
    assert {"--slurm", "--sbatch"} <= set(completions("headway sweep seed=0..4 --s", tmp_path))
    assert completions("headway list presets paper", tmp_path) == ["paper"]


@pytest.mark.parametrize("before", ["", "seed=0..4 --dry-run "])
def test_names_and_keys_are_completed_after_run(before: str, tmp_path: Path) -> None:
    line = f"headway run {before}"
    assert completions(f"{line}experiment=bus_mapp", tmp_path) == ["experiment=bus_mappo"]
    assert completions(f"{line}algo=mappo algo.gae", tmp_path) == ["algo.gae_lambda="]


def test_the_users_files_and_configurations_are_completed(tmp_path: Path) -> None:
    (tmp_path / "lab" / "experiment").mkdir(parents=True)
    (tmp_path / "lab" / "experiment" / "mine.yaml").write_text("seed: 1\n")
    assert completions("headway run lab/experiment/min", tmp_path) == ["lab/experiment/mine.yaml"]
    assert completions("headway run --config-dir lab experiment=min", tmp_path) == ["experiment=mine"]


def test_runs_and_studies_are_completed(tmp_path: Path) -> None:
    assert completions("headway evaluate ", tmp_path)[-1].startswith("-")
    run_id = keep_run(tmp_path / "runs", compose(["env=trivial", "algo=ippo"]), 3, "FINISHED")
    assert completions("headway evaluate triv", tmp_path) == [run_id]
    assert completions("headway plot to", tmp_path) == ["toys"]
    (tmp_path / "runs").rename(tmp_path / "elsewhere")
    assert completions("headway resume --store elsewhere triv", tmp_path) == [run_id]


def test_bash_completes_words_with_the_documented_line(tmp_path: Path) -> None:
    script = tmp_path / "headway"
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m headway_launch "$@"\n')
    script.chmod(0o755)
    line = "headway sweep experiment=bus_mapp"
    asked = f"""
        {argcomplete.shellcode(["headway"])}
        COMP_LINE='{line}' COMP_POINT={len(line)} COMP_TYPE=9 COMP_WORDS=(headway sweep experiment = bus_mapp)
        COMP_CWORD=4 _python_argcomplete headway
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    path = f"{tmp_path}:{os.environ['PATH']}"
    shown = subprocess.run(
        ["bash", "-c", asked], env={**os.environ, "PATH": path}, capture_output=True, text=True, check=True
    )
    assert shown.stdout == "bus_mappo \n"  # after the last break of words, with a blank


@pytest.mark.parametrize("group", ["experiment", "env", "algo", "preset", "backend", "energy"])
def test_every_option_of_a_group_is_proposed(group: str) -> None:
    assert override_completions([], f"{group}=") == [f"{group}={name}" for name in options()[group]]


def test_keys_are_those_of_the_chosen_environment_and_algorithm() -> None:
    assert {"env=", "seed=", "env_steps="} <= set(override_completions([], ""))
    assert "rollout.copies=" in override_completions([], "ro")
    assert "algo.kl_bound=" in override_completions([], "algo.")
    assert "algo.kl_bound=" not in override_completions(["algo=mappo"], "algo.")
    assert "env.args.capacity=" in override_completions(["env=bus"], "env.args.")
    assert "env.args.capacity=" not in override_completions(["env=trivial"], "env")
    assert "rollout=" not in override_completions([], "rollout")


def test_values_are_proposed_where_there_are_few() -> None:
    assert override_completions([], "backend.name=") == [
        f"backend.name={n}" for n in ("serial", "process", "ray")
    ]
    assert override_completions(["algo=mappo"], "algo.agent_id=") == [
        "algo.agent_id=true",
        "algo.agent_id=false",
        "algo.agent_id=null",
    ]
    assert "algo=ippo,mappo" in override_completions([], "algo=ippo,ma")
    assert override_completions([], "algo.lr=") == []
    assert override_completions([], "no.such.key=") == []

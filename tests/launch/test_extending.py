"""The how-to pages on external packages: their files are created, and their commands print what they show."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from headway.store.index import RunIndex, RunRow

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).resolve().parents[2]
PAGES = ("package", "environment", "algorithm", "wrapper")
GUIDE = "\n".join((PROJECT / "docs" / "howto" / f"{page}.md").read_text(encoding="utf-8") for page in PAGES)
_BLOCK = re.compile(r"^```(\w+)(?: (\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_MARK = "-- exit code"
_IN_ONE_PROCESS = f"""
import os, shlex, subprocess, sys
sys.path.append({str(PROJECT / "tests" / "support")!r})
from headway_launch.commands.main import run
from headway_launch.runner import training_process
from warm_training import WarmContext

training_process.get_context = lambda method: WarmContext()

def execute(line):
    words = shlex.split(os.path.expandvars(line))
    if words[0] == "export":
        name, value = words[1].split("=", 1)
        os.environ[name] = value
        return 0
    return run(words[1:]) if words[0] == "headway" else subprocess.run(words).returncode

for line in sys.argv[1:]:
    code = execute(line)
    print("{_MARK}", code, flush=True)
"""
"""Executes the lines of a shell without a process for each `headway`, and trains in warm processes."""
_BOTH_FORMS = """
import numpy as np
from crossing.envs import ENTRIES
from crossing.wrappers import Coarse, coarse, coarse_batch
from headway.wrappers.parallel import bounds_of

entry, arguments = ENTRIES["fast_junction"], Coarse(0.3)
native, face = entry.make(entry.config(), 1), entry.parallel_env(entry.config())
twin, env = coarse_batch(arguments, bounds_of(face)).wrap(native), coarse(face, arguments)
observed, (shown, _) = twin.reset(np.array([7], np.uint64)), env.reset(seed=7)
for _ in range(entry.config().steps):
    rows = np.array(list(shown.values()))
    np.testing.assert_array_equal(observed.observations[0], rows)
    np.testing.assert_allclose(rows / 0.3, np.round(rows / 0.3), atol=1e-6)
    outcome, observed = twin.step(np.zeros((1, 3), np.int64))
    shown, *_ = env.step({agent: 0 for agent in env.agents})
np.testing.assert_array_equal(outcome.final_observations[0], list(shown.values()))
"""


@dataclass(frozen=True)
class Command:
    """A command of the guide and the lines shown below it."""

    line: str
    shown: str

    @property
    def fails(self) -> bool:
        """Whether the command is an example of bad input."""
        return self.shown.startswith("headway: ")


def _files() -> dict[str, str]:
    return {name: text for _, name, text in _BLOCK.findall(GUIDE) if name}


def _commands() -> Iterator[Command]:
    for kind, _, text in _BLOCK.findall(GUIDE):
        if kind == "console":
            for piece in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
                line, _, shown = piece.partition("\n")
                yield Command(line, shown.strip())


COMMANDS = tuple(_commands())


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the guide's files."""
    folder = tmp_path_factory.mktemp("crossing-lab")
    for name, text in {"crossing/__init__.py": "", **_files()}.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def environment(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """Environment variables for the package, installed outside the virtual environment, and this Headway. The
    files of `pip install -e` are tested with the adapter of modules."""
    site = tmp_path_factory.mktemp("site")
    quietly = ["--quiet", "--disable-pip-version-check", "--no-index", "--no-deps", "--no-build-isolation"]
    install = [sys.executable, "-m", "pip", "install", *quietly, "--target", str(site), str(package)]
    subprocess.run(install, check=True, timeout=120)
    ours = [str(PROJECT / name) for name in ("platform", "envs", "algos", "launch")]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(site), *ours]),
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
    }


@pytest.fixture(scope="module")
def printed(package: Path, environment: Mapping[str, str]) -> list[tuple[int, str]]:
    """Exit code and output of every command, run one after another in one process, which imports once."""
    done = subprocess.run(
        [sys.executable, "-c", _IN_ONE_PROCESS, *(command.line for command in COMMANDS)],
        cwd=package, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True,
        timeout=300,
    )  # fmt: skip
    pieces = re.split(rf"^{_MARK} (\d+)\n", done.stdout, flags=re.MULTILINE)
    return [(int(code), text.strip()) for text, code in zip(pieces[::2], pieces[1::2], strict=False)]


@pytest.fixture(scope="module")
def runs(package: Path, printed: object) -> list[RunRow]:
    """Runs that the commands stored."""
    return RunIndex(package / "runs").rows()


def _as_shown(shown: str, text: str) -> bool:
    """Return whether `text` matches what the guide shows, in which `...` stands for anything."""
    pattern = ".*".join(re.escape(part) for part in shown.split("..."))
    return re.fullmatch(pattern, text, re.DOTALL) is not None


@pytest.mark.parametrize("index", range(len(COMMANDS)), ids=[command.line[:60] for command in COMMANDS])
def test_a_command_prints_what_the_guide_shows(index: int, printed: list[tuple[int, str]]) -> None:
    command, (code, text) = COMMANDS[index], printed[index]
    assert code == (2 if command.fails else 0), text
    assert _as_shown(command.shown, text), text
    if command.fails:
        assert "\n" not in text


def test_runs_are_stored_under_the_names_of_the_package(runs: list[RunRow]) -> None:
    assert {(row.environment, row.algorithm) for row in runs} == {
        ("crossing.junction", "ippo"),
        ("fast_junction", "custom"),
        ("fast_junction", "haa2c"),
        ("junction", "ispo"),
    }
    assert [row.status for row in runs] == ["FINISHED"] * 5
    assert all(row.env_steps == 2048 for row in runs)


def test_the_wrapper_and_its_twin_show_the_same_multiples(environment: Mapping[str, str]) -> None:
    """Over a whole episode, including the final observations."""
    subprocess.run([sys.executable, "-c", _BOTH_FORMS], env=environment, check=True, timeout=60)

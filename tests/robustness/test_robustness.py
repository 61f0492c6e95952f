"""The robustness campaign detects what it looks for, and a handful of its cases end well."""

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import strategies as st

from tests.robustness import files, forked, overrides
from tests.robustness.__main__ import report
from tests.robustness.damage import damage_file
from tests.robustness.files import Material, try_case
from tests.robustness.forked import run_forked
from tests.robustness.outcomes import MINUTES, Ended, Outcome, Tally, outcome_of
from tests.robustness.overrides import Search, shell_line


def _hang(words: Sequence[str]) -> int:
    time.sleep(60)
    return 0


def _raise(words: Sequence[str]) -> int:
    raise KeyError(words[0])


def _die(words: Sequence[str]) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _write(text: str, code: int) -> Callable[[Sequence[str]], int]:
    def write(words: Sequence[str]) -> int:
        os.write(2, text.encode())
        return code

    return write


@pytest.mark.parametrize(
    ("command", "outcome"),
    [
        (_write("", 0), Outcome.ACCEPTED),
        (_write("headway: a notice\nheadway: seed=x is wrong; write 7\n", 2), Outcome.CLEAR),
        (_write("seed 0 4/4\nheadway: cannot write x; free some space\n", 2), Outcome.CLEAR),
        (_write("a.py:1: UserWarning: x\nheadway: no file; give one\n", 2), Outcome.UNEXPECTED),
        (_write("headway: unexpected KeyError: 'x' (--debug shows where)\n", 2), Outcome.UNEXPECTED),
        (_write("headway: one line\nand another\n", 2), Outcome.UNEXPECTED),
        (_write("headway: a\x1b[31mb\n", 2), Outcome.UNEXPECTED),
        (_write("", 2), Outcome.UNEXPECTED),
        (_write("headway: stopped\n", 130), Outcome.UNEXPECTED),
        (_raise, Outcome.UNEXPECTED),
        (_die, Outcome.UNEXPECTED),
        (_hang, Outcome.HUNG),
    ],
)  # fmt: skip
def test_ends_of_commands_are_told_apart(
    command: Callable[[Sequence[str]], int], outcome: Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked, "run", command)
    seconds = 0.2 if outcome is Outcome.HUNG else 60.0
    assert outcome_of(run_forked(["list"], tmp_path, seconds, tmp_path)) is outcome


@pytest.mark.slow
def test_a_failure_is_shrunk_and_reported_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two faults: a 7 anywhere, and a 3 with no 7."""

    def execute(words: Sequence[str], folder: Path, seconds: float, scratch: Path) -> Ended:
        fault = next(
            (f"{error}Error" for digit, error in (("7", "Key"), ("3", "Type")) if digit in words), ""
        )
        return Ended(2, f"headway: unexpected {fault}: {len(words)}\n" if fault else "headway: no; write 1\n")

    tally = Tally("overrides")
    digits = st.lists(st.integers(0, 9).map(str), max_size=6).map(tuple)
    Search(tally, tmp_path, execute).run(digits, 300, 1)
    assert sorted(line.splitlines()[0] for line in tally.failures) == ["headway 3", "headway 7"]
    assert tally.counts[Outcome.UNEXPECTED] > 2
    assert tally.counts.total() >= 300
    assert report([tally]) == 1
    assert report([Tally("other", Counter({Outcome.CLEAR: 3}))]) == 0


def test_a_command_line_is_written_for_a_shell() -> None:
    assert shell_line(["run", "a=b c", "\x1b'\udcff"]) == "headway run 'a=b c' $'\\x1b\\'\\xff'"


def _store(folder: Path) -> Material:
    for name in ("one", "two"):
        (folder / name).mkdir(parents=True)
        (folder / name / "run.json").write_text(f'{{"run_id": "{name}"}}')
    return Material(folder, (("runs", "--format", "json"),), "one/*", "two")


@pytest.mark.parametrize("lost", ["listed", "unlisted", "removed", "changed"])
def test_a_lost_run_is_noticed(lost: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def command(words: Sequence[str]) -> int:
        os.write(1, b"" if lost == "unlisted" else b"two")
        if lost == "removed":
            Path("two/run.json").unlink()
        if lost == "changed":
            Path("two/run.json").write_text('{"run_id": "two" }')
        return 0

    monkeypatch.setattr(forked, "run", command)
    outcome, shown, _ = try_case([_store(tmp_path / "store")], 1, 0, tmp_path / "case")
    assert outcome is (Outcome.ACCEPTED if lost == "listed" else Outcome.LOST)
    assert "one/run.json" in shown


def test_damage_changes_the_file_and_no_other(tmp_path: Path) -> None:
    whole = '{"a": [1, {"b": "c"}]}'
    (tmp_path / "other").write_text("kept")
    kinds = set()
    for case in range(60):
        path = tmp_path / "values.json"
        path.write_text(whole)
        kinds.add(damage_file(path, random.Random(case)).removeprefix(f"{path}: ").split()[0])
        regular = path.is_file() and not path.is_symlink()
        assert not regular or path.read_bytes() != whole.encode()
        assert [each.name for each in tmp_path.iterdir() if each != path] == ["other"]
        assert (tmp_path / "other").read_text() == "kept"
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink(missing_ok=True)
    assert len(kinds) >= 6


@pytest.mark.slow
@pytest.mark.parametrize(("area", "cases"), [(overrides, 4), (files, 2)])
def test_a_few_cases_end_well(area: ModuleType, cases: int, tmp_path: Path) -> None:
    [tally] = area.campaign(replace(MINUTES, overrides=4, files=2), 1, tmp_path)
    assert tally.failures == []
    assert tally.counts.total() == cases

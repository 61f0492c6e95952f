"""Provenance of the runs in a report."""

import subprocess
from types import SimpleNamespace
from typing import Any

import pytest

from headway_launch.report.sections import provenance


@pytest.mark.parametrize(
    ("application", "ending"),
    [("in_turns", "."), ("arrival", ", except for algorithms that apply gradients")],
)
def test_algorithms_that_apply_gradients_on_arrival_are_excepted_from_reproduction(
    monkeypatch: pytest.MonkeyPatch, application: str, ending: str
) -> None:
    algos = [{"name": "ippo"}, {"name": "a3c", "application": application}]
    cells = {("task", algo["name"]): [SimpleNamespace(directory=algo)] for algo in algos}
    data: Any = SimpleNamespace(cells=cells)
    monkeypatch.setattr(provenance, "configuration", lambda directory: {"algo": directory})
    assert provenance._determinism_exception(data).startswith(ending)


def test_a_shell_reads_a_command_over_several_lines_as_one() -> None:
    words = [
        f"key{place}={value}" for place in range(30) for value in ("1e-3", "'a - b'", '"it\'s"', "[x,y]")
    ]
    line = " ".join(["headway run", *words])
    wrapped = provenance._wrapped(line)
    assert max(map(len, wrapped.splitlines())) <= 106
    function = "headway() { printf '%s\\n' \"$@\"; }\n"
    read = [
        subprocess.run(["sh", "-c", function + text], capture_output=True, text=True, check=True).stdout
        for text in (line, wrapped)
    ]
    assert read[0] == read[1]
    assert len(read[0].splitlines()) == 1 + len(words)
    assert provenance._wrapped("# it's " + line) == "# it's " + line

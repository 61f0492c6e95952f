"""Provenance of the runs in a report."""

from types import SimpleNamespace
from typing import Any

import pytest

from headway_launch.report import provenance_section


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
    monkeypatch.setattr(provenance_section, "configuration", lambda directory: {"algo": directory})
    assert provenance_section._determinism_exception(data).startswith(ending)

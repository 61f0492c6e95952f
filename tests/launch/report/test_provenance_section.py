"""What a report says of how its runs were made."""

from types import SimpleNamespace
from typing import Any

import pytest

from headway_launch.report import provenance_section


@pytest.mark.parametrize(
    ("algos", "ending"),
    [
        ([{"name": "ippo"}, {"name": "a3c", "application": "in_turns"}], "."),
        (
            [{"name": "ippo"}, {"name": "a3c", "application": "arrival"}],
            ", but for algorithms whose gradients",
        ),
    ],
)
def test_runs_whose_gradients_come_as_they_come_are_not_said_to_repeat(
    monkeypatch: pytest.MonkeyPatch, algos: list[dict[str, str]], ending: str
) -> None:
    data: Any = SimpleNamespace(
        cells={("task", algo["name"]): [SimpleNamespace(directory=algo)] for algo in algos}
    )
    monkeypatch.setattr(provenance_section, "configuration", lambda directory: {"algo": directory})
    assert provenance_section._determinism_exception(data).startswith(ending)

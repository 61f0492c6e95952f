"""Statements of the site's pages about the code, where they can be compared."""

import shlex
from collections.abc import Iterator
from pathlib import Path

from headway_envs.api import IntersectionConfig
from headway_launch.experiments.compose import compose

DOCS = Path(__file__).resolve().parents[2] / "docs"


def _rows(page: str, heading: str) -> Iterator[list[str]]:
    """Yield the rows of the first table from a heading on, as cells."""
    text = (DOCS / page).read_text(encoding="utf-8")
    lines = text[text.index(heading) :].splitlines()
    first = next(index for index, line in enumerate(lines) if line.startswith("|"))
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            return
        yield [cell.strip() for cell in line.strip("|").split("|")]


def test_the_weights_of_the_intersection_are_its_defaults() -> None:
    rows = {
        row[0].replace(" ", "_"): float(row[1]) for row in _rows("environments/intersection.md", "## Reward")
    }
    reward = IntersectionConfig().reward
    assert tuple(rows.values()) == reward.weights
    assert {term: getattr(reward, term) for term in rows} == rows


def test_the_commands_on_configuration_take_the_values_shown() -> None:
    rows = list(_rows("guide/configuration.md", "| command |"))
    assert len(rows) == 3
    for command, value, _ in rows:
        _, _, *overrides = shlex.split(command.strip("`"))
        assert compose(overrides).algo_config.lr == float(value)

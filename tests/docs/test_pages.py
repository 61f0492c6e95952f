"""What pages of the site say about the code, where it can be compared."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from headway.registry import env_entries
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


def _entries(cell: str) -> list[int]:
    """Return the entries that a cell such as `16, 17` or `18 to 41` names."""
    first, _, last = cell.partition(" to ")
    return list(range(int(first), int(last) + 1)) if last else [int(each) for each in cell.split(",")]


@pytest.mark.parametrize(
    ("page", "environment", "groups"),
    [
        ("bus", "bus", 1),
        ("bus_published", "bus_published", 1),
        ("intersection", "intersection", 1),
        ("merge", "merge", 5),
    ],
)
def test_the_table_of_an_observation_has_each_of_its_entries(
    page: str, environment: str, groups: int
) -> None:
    """`groups`: number of times that the entries of the table stand in an observation."""
    entry = env_entries()[environment]
    env = entry.make(entry.prepare(entry.config()), 1)
    size = env.spec.observation_size
    env.close()
    named = [each for row in _rows(f"environments/{page}.md", "## Observation") for each in _entries(row[0])]
    assert named == list(range(size // groups))


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

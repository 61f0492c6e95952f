"""What the report says was trained, and how it was evaluated."""

from collections.abc import Callable
from pathlib import Path

from sections import section_of, tables, words

from headway_launch.report.sections.setup import setup_section


def test_policies_seeds_steps_and_episodes_are_named(keep_run: Callable[..., Path], root: Path) -> None:
    rules = {"random": -20.0, "optimal": 10.0}
    for algorithm, seeds in (("ippo", (0, 1, 2)), ("ia2c", (3, 5))):
        for seed in seeds:
            keep_run(("experiment=toy_tracking", f"algo={algorithm}"), seed, 5.0, rules=rules)
    setup = section_of(root, setup_section)
    table = tables(setup)["setup"]
    assert table.headings[0] == "controller"
    assert [(row[0], row[1], row[3], row[4]) for row in table.rows] == [
        ("ia2c", "independent", "3,5", "40"),
        ("ippo", "independent", "0..2", "40"),
    ]
    assert table.exact["seed"].tolist() == [3, 5, 0, 1, 2]
    assert "2 episodes per point of the curves, 4 episodes in the last evaluation" in words(setup)
    assert words(setup).endswith("the rules `optimal`, `random`.")

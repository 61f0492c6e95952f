"""Stored rule episodes of a cell are reused by later sessions."""

from pathlib import Path
from typing import Any

import pytest

from headway.config.experiment import StoreConfig
from headway.events import Row
from headway.store.session import Cell, SessionStore
from headway_launch.experiments.compose import compose
from headway_launch.runner import cell as cell_module
from headway_launch.runner.cell import SessionCell
from headway_launch.runner.jobs import CellPlan

RULES = ("evaluation.rules=[optimal]", "evaluation.episodes=3", "evaluation.final_episodes=3")
TINY = ("env=trivial", "algo=ippo", "env.args.agents=2", "env.args.steps=20", "study=kept", *RULES)


def test_another_evaluation_seed_plays_rules_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Episode seeds count from 0 for every evaluation seed, which is not a parameter of the cell."""
    roots: list[int] = []
    play = cell_module.rule_episodes

    def counted(*arguments: Any) -> dict[str, list[Row]]:  # noqa: ANN401 - passed on
        roots.append(arguments[3])
        return play(*arguments)

    monkeypatch.setattr(cell_module, "rule_episodes", counted)
    store = SessionStore(StoreConfig(root=str(tmp_path)))
    cell = Cell(store, "kept", "trivial", "ippo", {})
    run = cell.begin_run(0, "seed: 0\n", {}, iterations=1)
    run.finish("FINISHED", {})

    def rules_after(*overrides: str) -> int:
        experiment = compose((*TINY, f"store.root={tmp_path}", *overrides))
        work = SessionCell(store, CellPlan(experiment, jobs=(), finished=(run.directory,)))
        work.play_rules({})
        return len(work.rules["optimal"])

    other = "evaluation.seed=77"
    assert [rules_after(), rules_after()] == [3, 3]
    assert len(roots) == 1
    assert [rules_after(other), rules_after(other)] == [3, 3]
    assert roots[1:] == [77]
    assert rules_after() == 3
    assert len(roots) == 3
    [stored] = tmp_path.glob("kept/*.rules.json")
    stored.write_text('{"optimal": [1')
    assert [rules_after(), rules_after()] == [3, 3]
    assert len(roots) == 4
    store.close()

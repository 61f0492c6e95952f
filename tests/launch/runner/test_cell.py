"""Stored rule episodes of a cell are reused by later sessions."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from headway.config.experiment import StoreConfig
from headway.events import Row
from headway.store.session import SessionStore
from headway_launch.console.progress_display import CountedProgress
from headway_launch.experiments.compose import Experiment, compose
from headway_launch.runner import cell as cell_module
from headway_launch.runner.cell import SessionCell
from headway_launch.runner.jobs import CellPlan

RULES = ("evaluation.rules=[optimal]", "evaluation.episodes=3", "evaluation.final_episodes=3")
TINY = ("env=trivial", "algo=ippo", "env.args.agents=2", "env.args.steps=20", "study=kept", *RULES)


def test_another_evaluation_seed_plays_the_rules_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Episode seeds count from 0 for every evaluation seed, which is not a parameter of the cell."""
    roots: list[int] = []
    play = cell_module.rule_episodes

    def counted(
        experiment: Experiment,
        prepared: object,
        rules: Sequence[str],
        root: int,
        episodes: int,
        progress: CountedProgress,
    ) -> dict[str, list[Row]]:
        roots.append(root)
        return play(experiment, prepared, rules, root, episodes, progress)

    monkeypatch.setattr(cell_module, "rule_episodes", counted)
    store = SessionStore(StoreConfig(root=str(tmp_path)))
    cell = store.begin_cell("kept", "trivial", "ippo", {})
    run = cell.begin_run(0, "seed: 0\n", {}, iterations=1)
    run.finish("FINISHED", {})

    def rules_after(*overrides: str) -> int:
        plan = CellPlan(
            compose((*TINY, f"store.root={tmp_path}", *overrides)), jobs=(), finished=(run.directory,)
        )
        work = SessionCell(store, plan)
        work.play_rules({})
        return len(work.rules["optimal"])

    assert rules_after() == 3
    assert rules_after() == 3
    assert len(roots) == 1
    assert rules_after("evaluation.seed=77") == 3
    assert roots[1:] == [77]
    assert rules_after("evaluation.seed=77") == 3
    assert len(roots) == 2
    assert rules_after() == 3
    assert len(roots) == 3
    store.close()

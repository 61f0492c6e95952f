"""Studies written into a store by hand: real configurations with chosen results."""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
from stored_runs import ELSEWHERE
from stored_runs import keep as keep_anyhow

from headway.events import Row
from headway.store.atomic_files import write_json
from headway.store.run_folder import Status, cell_name, rules_file
from headway_launch.experiments.compose import compose
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.parameters import cell_parameters, full_mapping

EPISODES = 4


@lru_cache
def composed(overrides: tuple[str, ...]) -> Experiment:
    return compose(overrides)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def keep_run(root: Path) -> Callable[..., Path]:
    """Store a run in `root`, see `keeper`."""
    return keeper(root)


@pytest.fixture(scope="session")
def keep_run_in() -> Callable[[Path], Callable[..., Path]]:
    """(root) -> the `keep_run` of that store, for studies that tests share."""
    return keeper


def keeper(root: Path) -> Callable[..., Path]:
    """Return a function that stores a run whose curve climbs from 0 to `final`; evaluation episode i returns
    `final` + i, a rule's returns its value + i. `metrics` are the same in all episodes, for rules unless
    `rule_metrics` differs. Episodes end during training in the iterations `trained` (default: in all). The
    last evaluation has `last` episodes."""

    def keep(
        overrides: Sequence[str],
        seed: int,
        final: float,
        status: Status = "FINISHED",
        study: str = "study",
        rules: Mapping[str, float] | None = None,
        energy: Mapping[str, Any] | None = None,
        points: int = 5,
        rule_metrics: Mapping[str, float] | None = None,
        trained: Collection[int] | None = None,
        last: int = EPISODES,
        **metrics: float,
    ) -> Path:
        experiment = composed((*overrides, f"study={study}", "evaluation.episodes=2"))
        parameters = {name: str(value) for name, value in cell_parameters(experiment).items()}
        env, algo = experiment.config.env.id, experiment.algo_name
        mapping = full_mapping(experiment, [seed])
        curve: list[Row] = []
        for iteration in range(points):
            value = final * min(iteration / 2, 1.0)
            row: Row = {"iteration": iteration, "env_steps": 10 * iteration, "wall_s": 1.0}
            if trained is None or iteration in trained:
                row["training/return"] = value / 2
            curve.append({**row, "evaluation_greedy/return": value, **_of_curve(metrics)})
        label: Row = {"iteration": 4, "env_steps": 40, "mode": "greedy", "final": 1, "length": 5}
        days = [{**label, "episode_seed": day, "return": final + day, **metrics} for day in range(last)]
        cell = cell_name(env, algo, parameters)
        directory = keep_anyhow(
            root, study, seed, env, algo, cell,
            {"final_reward": final, "cpu_seconds": 3.0 + seed, "steps_per_second": 10.0, **(energy or {})},
            mapping, {"curve": curve, "evaluation": days}, iterations=4, session=ELSEWHERE, status=status,
            policies=str(mapping["algo"]["policies"]), parameters=parameters, durable_env_steps=40,
            tags={"version.headway": "0.1.0", "git.dirty": "true"}, preset=experiment.config.preset,
        )  # fmt: skip
        played = {
            rule: [
                {"episode_seed": day, "return": value + day, **metrics, **(rule_metrics or {})}
                for day in range(EPISODES)
            ]
            for rule, value in (rules or {}).items()
        }
        if played:
            write_json(rules_file(root, study, cell), played)
        return directory

    return keep


def _of_curve(metrics: Mapping[str, float]) -> dict[str, float]:
    return {f"evaluation_greedy/{name}": value for name, value in metrics.items()}

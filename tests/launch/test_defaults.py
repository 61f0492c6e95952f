"""`algo=NAME` alone learns on an environment that it was not tuned for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headway.registry import algo_entries
from headway.rollout.episodes import evaluate_rule
from headway.store.parquet_log import read_rows
from headway.training.loop import train
from headway_launch.experiments.compose import compose
from headway_launch.runner.jobs import plan_jobs

pytestmark = pytest.mark.slow

ENV_STEPS = {"coma": 20_000, "ddpg": 4_000, "madqn": 5_000}
"""Budgets other than 10,000: COMA needs more, and each step of DDPG and MADQN takes long."""


@pytest.mark.parametrize("algorithm", algo_entries())
def test_defaults_close_half_of_the_gap_from_random_to_optimal_play(algorithm: str, tmp_path: Path) -> None:
    experiment = compose(
        [
            f"env={'tracking' if algorithm == 'ddpg' else 'visitors'}", f"algo={algorithm}", "seed=1",
            f"env_steps={ENV_STEPS.get(algorithm, 10_000)}", "backend=serial", "evaluation.modes=[greedy]",
        ]
    )  # fmt: skip
    [planned], evaluation = plan_jobs(experiment), experiment.config.evaluation
    train(replace(planned.training, directories=(str(tmp_path),)), lambda event: None, lambda: False)
    last = [float(row["return"]) for row in read_rows(tmp_path, "evaluation") if row["final"]]

    def mean_return(rule: str) -> float:
        make, prepared = experiment.env.rules[rule].make, planned.training.plan.prepared
        played = evaluate_rule(experiment.env.make, make, prepared, evaluation.seed, evaluation.last_episodes)
        return float(np.mean([each["return"] for each in played]))

    assert len(last) == evaluation.last_episodes
    assert np.mean(last) > (mean_return("random") + mean_return("optimal")) / 2

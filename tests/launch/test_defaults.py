"""`algo=NAME` alone learns on an environment that it was not tuned for."""

from pathlib import Path

import numpy as np
import pytest

from headway.registry import algo_entries
from headway.rollout.episodes import evaluate_rule
from headway.store.index import RunIndex
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose

pytestmark = pytest.mark.slow

ENV_STEPS = {"coma": 20_000}
"""Of algorithms that need more than 10,000."""


@pytest.mark.parametrize("algorithm", algo_entries())
def test_defaults_close_half_of_the_gap_between_random_and_optimal_play(
    algorithm: str, tmp_path: Path
) -> None:
    words = [
        f"env={'tracking' if algorithm == 'ddpg' else 'visitors'}", f"algo={algorithm}", "seed=1",
        f"env_steps={ENV_STEPS.get(algorithm, 10_000)}", "backend=serial", "energy=off",
        "evaluation.rules=[]", f"store.root={tmp_path}",
    ]  # fmt: skip
    assert run(["run", *words]) == 0
    (row,) = RunIndex(tmp_path).rows()
    experiment = compose(words)
    prepared, evaluation = experiment.prepare().prepared, experiment.config.evaluation

    def mean_return(rule: str) -> float:
        make = experiment.env.rules[rule].make
        played = evaluate_rule(experiment.env.make, make, prepared, evaluation.seed, evaluation.last_episodes)
        return float(np.mean([each["return"] for each in played]))

    assert row.final_reward is not None
    assert row.final_reward > (mean_return("random") + mean_return("optimal")) / 2

"""The intersection's benchmark measures the start of the experiments' own trainings."""

import pytest

from benchmarks.crossing import TRAINED_STEPS, TRAININGS, _training
from benchmarks.measurement import WARM_UP
from headway.config.schema import build
from headway.registry import algo_entry, env_entry
from headway_launch.experiments.compose import compose


@pytest.mark.parametrize(("experiment", "algo"), TRAININGS)
def test_the_first_part_of_the_experiments_own_training_is_measured(experiment: str, algo: str) -> None:
    task, budget = _training(experiment, algo)
    composed = compose([f"experiment={experiment}", f"algo={algo}"])
    assert budget == composed.config.env_steps
    assert (task.env, task.algo) == ("intersection", composed.algo_name)
    assert build(env_entry(task.env).config, task.env_args) == composed.training_env_config
    assert build(algo_entry(task.algo).config, task.algo_args) == composed.algo_config
    assert TRAINED_STEPS <= task.copies * task.steps * (task.iterations - WARM_UP) < budget
    assert task.stack == composed.config.backend.stack
    alone, _ = _training(experiment, algo, alone=True)
    assert (alone.stack, alone.workers * alone.block) == (1, task.copies)
    assert task.workers == task.stack * alone.workers

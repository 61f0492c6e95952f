"""Estimate of the cost of `bus_table3`."""

import pytest
from covering import quick_or_slow

from benchmarks import table3
from benchmarks.table3 import NINE, Cost, cost_of
from headway_launch.experiments.compose import compose


def test_the_cost_is_measured_per_stack(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table3, "MIN_MEASURED_S", 0.0)
    small = ["seed=0..3", "backend.stack=2", "env_steps=3_000", "env.args.scenario=line"]
    quick = ["evaluation.every=1_500", "evaluation.episodes=1", "evaluation.final_episodes=3"]
    cost = cost_of(compose(["experiment=bus_table3", "algo=ia2c", *small, *quick]))
    assert (cost.stack, cost.seeds, cost.iterations, cost.evaluations) == (2, 4, 3, 5.0)
    assert cost.iteration_s > 0
    assert cost.evaluation_s > 0


def test_hours_are_summed_over_all_stacks() -> None:
    assert Cost(2.0, 30.0, iterations=400, evaluations=25, stack=10, seeds=50).hours == pytest.approx(
        5 * (800 + 750) / 3600
    )


@pytest.mark.parametrize("algorithm", quick_or_slow({name: (name,) for name in NINE}, "mappo", "hatrpo"))
def test_the_study_has_the_published_settings(algorithm: str) -> None:
    experiment = compose(["experiment=bus_table3", f"algo={algorithm}"])
    config, algo = experiment.config, experiment.algo_config
    assert (len(config.seed), config.env_steps) == (50, 400_000)
    assert config.rollout.copies * config.rollout.steps == 1000
    assert (algo.policies, algo.model.hidden) == ("independent", (128, 128))
    assert (experiment.env_config.agents, experiment.env_config.reward.scope) == (5, "own")
    assert len(config.seed) % config.backend.stack == 0

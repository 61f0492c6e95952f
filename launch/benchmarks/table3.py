"""Cost of the study `bus_table3`: CPU time of iterations and evaluations per algorithm, and in total."""

import time
from contextlib import closing
from dataclasses import dataclass

from headway.registry import algo_entry
from headway.rollout.episodes import EvaluationRequest, evaluate_policy
from headway.rollout.plan import RolloutPlan
from headway.rollout.serial_collector import SerialCollector
from headway.training.modes import SynchronousMode
from headway_launch.console.threads import limit_threads
from headway_launch.experiments.compose import Experiment, compose
from headway_launch.runner.calibration import evaluations_left

NINE = ("ia2c", "ippo", "itrpo", "maa2c", "coma", "mappo", "matrpo", "happo", "hatrpo")
CORES = 2
MIN_MEASURED_S = 3.0
"""Minimum duration of the measured iterations, CPU s; at least two iterations are measured."""


@dataclass(frozen=True)
class Cost:
    """Measured CPU time of one stack of seeds, and the numbers of iterations and evaluations of the study."""

    iteration_s: float
    """CPU seconds per iteration."""
    evaluation_s: float
    """CPU seconds per evaluation."""
    iterations: int
    """Number of iterations per seed in the study."""
    evaluations: float
    """Number of evaluations per seed in the study; the longer last one counts as several."""
    stack: int
    seeds: int

    @property
    def hours(self) -> float:
        """CPU hours of the study for all seeds."""
        stack = self.iterations * self.iteration_s + self.evaluations * self.evaluation_s
        return self.seeds / self.stack * stack / 3600.0


def report() -> None:
    """Print the table."""
    limit_threads()
    print("\n## Reproduction of BusEnv's table: CPU time of `bus_table3`\n")
    costs = {}
    for algorithm in NINE:
        costs[algorithm] = cost_of(compose(["experiment=bus_table3", f"algo={algorithm}"]))
        if len(costs) == 1:
            first = costs[algorithm]
            print(f"One process, stacks of {first.stack} seeds; evaluated policies are hardly trained.\n")
            print(f"| algorithm | CPU s/iteration | CPU s/evaluation | CPU h for {first.seeds} seeds |")
            print("|---|---:|---:|---:|")
        cost = costs[algorithm]
        print(
            f"| {algorithm} | {cost.iteration_s:.3f} | {cost.evaluation_s:.2f} | {cost.hours:.2f} |",
            flush=True,
        )
    total = sum(cost.hours for cost in costs.values())
    print(f"\nTotal: {total:.1f} CPU hours, {total / CORES:.1f} hours on {CORES} dedicated cores.")


def cost_of(experiment: Experiment) -> Cost:
    """Measure one stack of seeds of an experiment in this process."""
    config, setup = experiment.config, experiment.prepare()
    seeds = config.seed[: config.backend.stack]
    entry = algo_entry(experiment.algo_name)
    policy = entry.acting_policy(experiment.algo_config, setup.spec)
    plan = RolloutPlan.of(
        config.rollout, setup.entry.make, setup.entry.preload, setup.prepared, setup.spec, policy, seeds
    )
    learner = entry.learner(experiment.algo_config, setup.spec, seeds, "cpu")
    with closing(SerialCollector(plan)) as collector:
        collector.begin()
        mode, done = SynchronousMode(learner, collector, 0, config.start, config.iterations), 1
        mode.iterate(1, 0.0)
        began = time.process_time()
        while done < 3 or time.process_time() - began < MIN_MEASURED_S:
            done += 1
            mode.iterate(done, 0.0)
        iteration = (time.process_time() - began) / (done - 1)
    began = time.process_time()
    evaluation = config.evaluation
    for mode_name in evaluation.modes:
        greedy = mode_name == "greedy"
        for request in EvaluationRequest.split(evaluation.seed, evaluation.episodes, greedy, plan.spec):
            evaluate_policy(plan, learner.acting_parameters(), request)
    return Cost(
        iteration_s=iteration,
        evaluation_s=time.process_time() - began,
        iterations=config.iterations,
        evaluations=1.0 + evaluations_left(config, 0),  # the first is before training
        stack=len(seeds),
        seeds=len(config.seed),
    )

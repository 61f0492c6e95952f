"""What the study `bus_table3` takes: CPU seconds of iterations and evaluations of each algorithm, and all."""

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
AT_LEAST_S = 3.0
"""Iterations are measured for so many CPU seconds, at least two."""


@dataclass(frozen=True)
class Cost:
    """CPU seconds of a stack of an algorithm, and what the study needs of them."""

    iteration_s: float
    evaluation_s: float
    """Of the episodes of one evaluation."""
    iterations: int
    """Of the study, for one seed."""
    evaluations: float
    """Of the study, for one seed; the last, which is longer, counts for several."""
    stack: int
    seeds: int

    @property
    def hours(self) -> float:
        """CPU hours of all seeds."""
        stack = self.iterations * self.iteration_s + self.evaluations * self.evaluation_s
        return self.seeds / self.stack * stack / 3600.0


def report() -> None:
    """Print the table."""
    limit_threads()
    print("\n## BusEnv's table anew: CPU time of `bus_table3`\n")
    costs = {}
    for algorithm in NINE:
        costs[algorithm] = cost_of(compose(["experiment=bus_table3", f"algo={algorithm}"]))
        if len(costs) == 1:
            first = costs[algorithm]
            print(
                f"One process, stacks of {first.stack} seeds; evaluations are of policies hardly trained.\n"
            )
            print(f"| algorithm | CPU s an iteration | CPU s an evaluation | CPU h of {first.seeds} seeds |")
            print("|---|---:|---:|---:|")
        cost = costs[algorithm]
        print(
            f"| {algorithm} | {cost.iteration_s:.3f} | {cost.evaluation_s:.2f} | {cost.hours:.2f} |",
            flush=True,
        )
    whole = sum(cost.hours for cost in costs.values())
    print(f"\nThe whole: {whole:.1f} CPU hours, {whole / CORES:.1f} hours on {CORES} cores of its own.")


def cost_of(experiment: Experiment) -> Cost:
    """Measure a stack of seeds of an experiment on an environment that is prepared for it."""
    config, found = experiment.config, experiment.prepare()
    seeds = config.seed[: config.backend.stack]
    entry = algo_entry(experiment.algo_name)
    policy = entry.acting_policy(experiment.algo_config, found.spec)
    plan = RolloutPlan.of(
        config.rollout, found.entry.make, found.entry.preload, found.prepared, found.spec, policy, seeds
    )
    learner = entry.learner(experiment.algo_config, found.spec, seeds, "cpu")
    with closing(SerialCollector(plan)) as collector:
        collector.begin()
        mode, done = SynchronousMode(learner, collector), 1
        mode.iterate(1, 0.0)
        began = time.process_time()
        while done < 3 or time.process_time() - began < AT_LEAST_S:
            done += 1
            mode.iterate(done, 0.0)
        iteration = (time.process_time() - began) / (done - 1)
    began = time.process_time()
    evaluation = config.evaluation
    for mode_name in evaluation.modes:
        for request in EvaluationRequest.split(evaluation.seed, evaluation.episodes, mode_name == "greedy"):
            evaluate_policy(plan, learner.acting_parameters(), request)
    return Cost(
        iteration_s=iteration,
        evaluation_s=time.process_time() - began,
        iterations=config.iterations,
        evaluations=1.0 + evaluations_left(config, 0),  # the first is before training
        stack=len(seeds),
        seeds=len(config.seed),
    )

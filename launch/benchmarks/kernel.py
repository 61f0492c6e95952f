"""Speed of the bus kernel alone: agent-ticks per second on one core."""

import time
from collections.abc import Mapping

import numpy as np

from headway.contracts import child_seeds
from headway.registry import env_entry

TICKS = 1140


def report() -> None:
    """Print the table: copies x agents x ticks per second, including observations and rewards."""
    print("\n## The bus kernel: agent-ticks per second on one core\n")
    report_rates({"line": 16, "corridor": 16})


def report_rates(scenarios: Mapping[str, int]) -> None:
    """Print the table of scenarios, a mapping of name to number of copies."""
    print("| scenario | agents | copies | agent-ticks/s |")
    print("|---|---:|---:|---:|")
    entry = env_entry("bus")
    for scenario, copies in scenarios.items():
        prepared = entry.prepare(entry.config(scenario=scenario))
        env = entry.make(prepared, copies)
        env.reset(child_seeds(0, "benchmark", 0, copies))
        actions = np.ones((copies, env.spec.num_agents), np.int64)
        for _ in range(TICKS):
            env.step(actions)
        began = time.process_time()
        for _ in range(TICKS):
            env.step(actions)
        rate = copies * env.spec.num_agents * TICKS / (time.process_time() - began)
        print(f"| {scenario} | {env.spec.num_agents} | {copies} | {rate:,.0f} |", flush=True)

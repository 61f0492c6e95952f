"""The bus kernel alone: agent-ticks a second on one core."""

import time

import numpy as np

from headway.contracts import child_seeds
from headway.registry import env_entry

COPIES = 16
TICKS = 1140


def report() -> None:
    """Print the table: copies x agents x ticks a second, with observations and rewards."""
    print("\n## The bus kernel: agent-ticks a second on one core\n")
    print("| scenario | agents | copies | agent-ticks/s |")
    print("|---|---:|---:|---:|")
    entry = env_entry("bus")
    for scenario in ("line", "corridor"):
        prepared = entry.prepare(entry.config(scenario=scenario))
        env = entry.make(prepared, COPIES)
        env.reset(child_seeds(0, "benchmark", 0, COPIES))
        actions = np.ones((COPIES, env.spec.num_agents), np.int64)
        for _ in range(TICKS):
            env.step(actions)
        began = time.process_time()
        for _ in range(TICKS):
            env.step(actions)
        rate = COPIES * env.spec.num_agents * TICKS / (time.process_time() - began)
        print(f"| {scenario} | {env.spec.num_agents} | {COPIES} | {rate:,.0f} |", flush=True)

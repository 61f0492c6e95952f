"""The merges: steps a second on one core, beside highway-env's own merge, and how long a training takes."""

import time
from importlib.util import find_spec

import numpy as np

from headway.contracts import BatchedEnv, child_seeds
from headway.registry import env_entry
from headway_launch.benchmarks.measuring import Task, measure

COPIES = 256
STEPS = 400
PEER_STEPS = 300
EPISODES = 20_000
EPISODE_STEPS = 100
STUDY_HOURS = 33.0
"""What the study says that the 20,000 episodes of one algorithm took it."""


def report() -> None:
    """Print the tables."""
    print("\n## The merges: environment steps a second on one core\n")
    print("Dynamics, observations, rewards, masks and resets together, CAVs acting at random.\n")
    print("| environment | density | supervisor | environment steps/s |")
    print("|---|---:|---|---:|")
    for name in ("merge", "merge_two_lane"):
        entry = env_entry(name)
        for density in (1, 2, 3):
            for supervisor in (False, True):
                config = entry.config(density=density, supervisor=supervisor)
                rate = _steps_per_second(entry.make(entry.prepare(config), COPIES))
                print(f"| {name} | {density} | {'on' if supervisor else 'off'} | {rate:,.0f} |", flush=True)
    if find_spec("highway_env") is None:
        print("\nhighway-env's merge-v0: not measured, highway-env is not installed.")
    else:
        print(f"| highway-env's merge-v0, one CAV | | off | {_peer_steps_per_second():,.0f} |", flush=True)
    _report_training()


def _steps_per_second(env: BatchedEnv) -> float:
    env.reset(child_seeds(0, "benchmark", 0, COPIES))
    draw = np.random.default_rng(0)
    actions = [draw.integers(0, 5, (COPIES, env.spec.num_agents)) for _ in range(20)]
    for step in range(20):
        env.step(actions[step])
    began = time.process_time()
    for step in range(STEPS):
        env.step(actions[step % len(actions)])
    return COPIES * STEPS / (time.process_time() - began)


def _peer_steps_per_second() -> float:
    """highway-env's merge with five vehicles, at the study's 15 simulation steps and 5 actions a second."""
    from highway_env.envs.merge_env import MergeEnv

    env = MergeEnv(config={"simulation_frequency": 15, "policy_frequency": 5})
    env.reset(seed=0)
    env.action_space.seed(0)
    began = time.process_time()
    for _ in range(PEER_STEPS):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    seconds = time.process_time() - began
    env.close()
    return PEER_STEPS / seconds


def _report_training() -> None:
    algo_args = {"policies": "shared", "model": {"hidden": [128, 128]}, "minibatches": 4}
    for workers in (1, 2):
        task = Task(
            env="merge",
            algo="mappo",
            env_args={},
            algo_args=algo_args,
            copies=40,
            steps=EPISODE_STEPS,
            block=20,
            iterations=12,
            backend="process",
            workers=workers,
        )
        result = measure([task])[0]
        minutes = EPISODES * EPISODE_STEPS / result.per_second / 60.0
        print(
            f"\nTraining (mappo, 128-128, density 2, {workers} worker{'s' * (workers > 1)}): "
            f"{result.per_second:,.0f} environment steps/s, {result.per_cpu_second:,.0f} a CPU second; "
            f"{EPISODES:,} episodes of {EPISODE_STEPS} steps would take {minutes:.1f} minutes, where the "
            f"study needed {STUDY_HOURS:g} hours.",
            flush=True,
        )

"""Speed of the merging environments, compared with highway-env's merge, and duration of a training."""

import time
from importlib.util import find_spec

import numpy as np

from benchmarks.measurement import Task, measure
from headway.contracts import BatchedEnv, child_seeds
from headway.registry import env_entry

COPIES = 256
STEPS = 400
PEER_STEPS = 300
EPISODES = 20_000
EPISODE_STEPS = 100
TRAINED_STEPS = 48_000
"""Number of environment steps per measured training."""
STUDY_HOURS = 33.0
"""Duration of 20,000 episodes of one algorithm according to the study, h."""


def report() -> None:
    """Print the tables."""
    print("\n## The merges: environment steps per second on one core\n")
    print("Including dynamics, observations, rewards, masks and resets; random actions.\n")
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
    """Return environment steps per CPU second of highway-env's merge with five vehicles, at the study's 15
    simulation steps and 5 actions per second."""
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
    """Print the speed of trainings of the experiment merge_study as in `headway run`, without evaluations."""
    print("\n## The merges: training one seed\n")
    print(
        "Experiment merge_study, one ramp lane, density 2; one learner and one rollout worker, which "
        f"alternate; episodes of {EPISODE_STEPS} steps, their maximum length. The study needed "
        f"{STUDY_HOURS:g} hours for {EPISODES:,} episodes of one algorithm.\n"
    )
    print(f"| algorithm | environment steps/s | steps/CPU s | episodes/s | {EPISODES:,} episodes, minutes |")
    print("|---|---:|---:|---:|---:|")
    for algo in ("mappo", "maacktr", "madqn"):
        words = ("experiment=merge_study", f"algo={algo}", "seed=0")
        result = measure([Task(words, TRAINED_STEPS)])[0]
        episodes = result.per_second / EPISODE_STEPS
        print(
            f"| {algo} | {result.per_second:,.0f} | {result.per_cpu_second:,.0f} | {episodes:,.0f} "
            f"| {EPISODES / episodes / 60.0:.1f} |",
            flush=True,
        )

"""Stable-Baselines3's PPO on MPE2's simple_spread: `python -m headway_launch.trials.spread_peer`.

The peer that IPPO and MAPPO stand beside in experiment mpe2_spread: the same environment and arguments,
environment steps and batch, the network, epochs and minibatches of `algo=ippo algo.policies=shared`, and as
many episodes of greedy play at the end. What a library has of its own stays its own: SuperSuit makes agents
into copies of one environment, so that all share a policy; normalisation is VecNormalize's. The episodes of
its evaluation have other seeds than ours. Needs `pip install stable-baselines3`, which is no part of Headway.
"""

import argparse
import sys
import time
from typing import Any, Final

import numpy as np

from headway.contracts.errors import HeadwayError

AGENTS, CYCLES, LOCAL_RATIO = 3, 25, 0.5
COPIES, STEPS = 20, 100
"""Copies of the environment and steps of each in a batch, as experiment mpe2_spread has them."""
HYPER_PARAMETERS: Final[dict[str, Any]] = {
    "learning_rate": 5e-4,
    "n_epochs": 5,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.01,
    "vf_coef": 1.0,
    "max_grad_norm": 0.5,
}
"""Those of `algo=ippo`."""
MINIBATCHES = 8
EVALUATION_SEED = 1_000_000


def train(seed: int, env_steps: int, episodes: int) -> dict[str, float]:
    """One seed: `return` (mean over agents and greedy episodes), `cpu_seconds` and `seconds` of training."""
    try:
        import stable_baselines3
        import supersuit
        import torch
        from mpe2 import simple_spread_v3
        from stable_baselines3.common.utils import set_random_seed
        from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
    except ImportError as error:
        missing = str(error.name).replace("_", "-")
        raise HeadwayError(f"{missing} is not installed: pip install {missing}") from error
    torch.set_num_threads(1)
    set_random_seed(seed)  # PPO's own seed asks for env.seed, which SuperSuit's copies have not
    arguments = {"N": AGENTS, "max_cycles": CYCLES, "local_ratio": LOCAL_RATIO}
    one = supersuit.pettingzoo_env_to_vec_env_v1(simple_spread_v3.parallel_env(**arguments))
    copies = supersuit.concat_vec_envs_v1(one, COPIES, num_cpus=1, base_class="stable_baselines3")
    for index, copy in enumerate(copies.unwrapped.vec_envs):
        copy.reset(seed=seed * COPIES + index)
    normalised = VecNormalize(VecMonitor(copies))
    began, cpu_began = time.perf_counter(), time.process_time()
    model = stable_baselines3.PPO(
        "MlpPolicy",
        normalised,
        n_steps=STEPS,
        batch_size=COPIES * STEPS * AGENTS // MINIBATCHES,
        policy_kwargs={"net_arch": [64, 64]},
        device="cpu",
        **HYPER_PARAMETERS,
    )
    model.learn(env_steps * AGENTS)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu_began
    env = simple_spread_v3.parallel_env(**arguments)
    totals = []
    for episode in range(episodes):
        observations, _ = env.reset(seed=EVALUATION_SEED + episode)
        total = 0.0
        while env.agents:
            rows = np.stack([observations[agent] for agent in env.agents])
            actions, _ = model.predict(normalised.normalize_obs(rows), deterministic=True)
            chosen = {agent: int(action) for agent, action in zip(env.agents, actions, strict=True)}
            observations, rewards, *_ = env.step(chosen)
            total += sum(rewards.values()) / AGENTS
        totals.append(total)
    return {"return": float(np.mean(totals)), "cpu_seconds": cpu_seconds, "seconds": seconds}


def main() -> int:
    """Train the seeds asked for, one after another; a line each."""
    parser = argparse.ArgumentParser(description="Stable-Baselines3's PPO on MPE2's simple_spread_v3.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--env-steps", type=int, default=2_000_000)
    parser.add_argument("--episodes", type=int, default=100, help="greedy episodes after training")
    asked = parser.parse_args()
    print("seed\tenv steps\treturn\tsteps/s\tsteps/CPU s")
    results = []
    try:
        for seed in asked.seeds:
            found = train(seed, asked.env_steps, asked.episodes)
            results.append(found["return"])
            speeds = [f"{asked.env_steps / found[name]:,.0f}" for name in ("seconds", "cpu_seconds")]
            print(f"{seed}\t{asked.env_steps}\t{found['return']:.3f}", *speeds, sep="\t", flush=True)
    except HeadwayError as error:
        print(f"headway: {error}", file=sys.stderr)
        return 2
    if len(results) > 1:
        print(f"mean\t\t{np.mean(results):.3f}\nstd\t\t{np.std(results, ddof=1):.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

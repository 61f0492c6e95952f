"""Stable-Baselines3's PPO on MPE2's simple_spread: `python -m tests.trials.spread_peer`.

Peer of IPPO and MAPPO in experiment mpe2_spread. The experiment's configuration gives the environment's
arguments, environment steps and batch, the network and hyper-parameters of `algo=ippo algo.policies=shared`,
and the number of greedy episodes at the end. Agents become copies of one environment by SuperSuit, so that
all share a policy; VecNormalize normalises.

SuperSuit returns ends of episodes as integers, which VecNormalize uses as indices: only the returns of copies
0 and 1 would be reset, and rewards scaled by sums over many episodes. They are therefore converted to
booleans here; `--as-supersuit` leaves them. SuperSuit reports the time limit of 25 steps as a termination,
after which PPO assumes a value of 0; with `--time-limits` PPO bootstraps there, as Headway does. Evaluation
episodes have other seeds than Headway's. Needs `pip install stable-baselines3`, which is not a dependency of
Headway.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from headway_launch.experiments.experiment import Experiment

VALUE_WEIGHT = 1.0
"""Weight of the critic's loss in the common loss; Headway's critic has its own optimiser."""
EVALUATION_SEED = 1_000_000


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise HeadwayError(f"{message}; see --help")


def spread_experiment() -> "Experiment":
    """Return the experiment that supplies the settings. Raises HeadwayError without mpe2."""
    from headway_launch.experiments.compose import compose

    return compose(["experiment=mpe2_spread", "algo=ippo", "algo.policies=shared"])


def hyper_parameters(experiment: "Experiment") -> dict[str, Any]:
    """Return the experiment's hyper-parameters by their names in Stable-Baselines3."""
    algo, rollout = experiment.algo_config, experiment.config.rollout
    rows = rollout.copies * rollout.steps * experiment.config.env.args["N"]
    return {
        "n_steps": rollout.steps,
        "batch_size": rows // algo.minibatches,
        "policy_kwargs": {"net_arch": list(algo.model.hidden)},
        "learning_rate": algo.lr,
        "n_epochs": algo.epochs,
        "gamma": algo.gamma,
        "gae_lambda": algo.gae_lambda,
        "clip_range": algo.clip,
        "ent_coef": algo.entropy_coeff,
        "vf_coef": VALUE_WEIGHT,
        "max_grad_norm": algo.grad_clip,
    }


def train(
    experiment: "Experiment", seed: int, env_steps: int, episodes: int, time_limits: bool, boolean_ends: bool
) -> dict[str, float]:
    """Train one seed; return `return` (mean over agents and greedy episodes), `cpu_seconds` and `seconds`.

    `time_limits`: mark ends of episodes as time limits. `boolean_ends`: convert ends to booleans (see the
    module). Raises HeadwayError if a package is missing.
    """
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
    arguments, number = dict(experiment.config.env.args), experiment.config.rollout.copies
    torch.set_num_threads(1)
    set_random_seed(seed)  # PPO's own seed needs env.seed, which SuperSuit's copies lack
    one = supersuit.pettingzoo_env_to_vec_env_v1(simple_spread_v3.parallel_env(**arguments))
    copies = supersuit.concat_vec_envs_v1(one, number, num_cpus=1, base_class="stable_baselines3")
    for index, copy in enumerate(copies.unwrapped.vec_envs):
        copy.reset(seed=seed * number + index)
    if boolean_ends:
        copies.step_wait = _with_boolean_ends(copies.step_wait)
    if time_limits:
        copies.step_wait = _with_time_limits(copies.step_wait)
    normalised = VecNormalize(VecMonitor(copies))
    began, cpu_began = time.perf_counter(), time.process_time()
    model = stable_baselines3.PPO("MlpPolicy", normalised, device="cpu", **hyper_parameters(experiment))
    model.learn(env_steps * arguments["N"])
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
            total += sum(rewards.values()) / arguments["N"]
        totals.append(total)
    return {"return": float(np.mean(totals)), "cpu_seconds": cpu_seconds, "seconds": seconds}


def _with_boolean_ends(wait: Callable[[], tuple[Any, ...]]) -> Callable[[], tuple[Any, ...]]:
    """Return a `step_wait` that reports ends of episodes as booleans."""

    def step_wait() -> tuple[Any, ...]:
        observations, rewards, ended, infos = wait()
        return observations, rewards, np.asarray(ended, dtype=bool), infos

    return step_wait


def _with_time_limits(wait: Callable[[], tuple[Any, ...]]) -> Callable[[], tuple[Any, ...]]:
    """Return a `step_wait` that marks every end as a time limit in the infos."""

    def step_wait() -> tuple[Any, ...]:
        observations, rewards, ended, infos = wait()
        for info, end in zip(infos, ended, strict=True):
            info["TimeLimit.truncated"] = bool(end)
        return observations, rewards, ended, infos

    return step_wait


def main() -> int:
    """Train the seeds in turn, and print one line per seed."""
    parser = _Parser(description="Stable-Baselines3's PPO on MPE2's simple_spread_v3.")
    parser.add_argument("--seeds", type=int, nargs="+", help="(default: the experiment's)")
    parser.add_argument("--env-steps", type=int, help="(default: the experiment's)")
    parser.add_argument(
        "--episodes", type=int, help="greedy episodes after training (default: evaluation.final_episodes)"
    )
    parser.add_argument(
        "--time-limits",
        action="store_true",
        help="mark ends of episodes as time limits, at which PPO bootstraps",
    )
    parser.add_argument(
        "--as-supersuit", action="store_true", help="leave ends as integers, which VecNormalize misreads"
    )
    results = []
    try:
        asked = parser.parse_args()
        _check(asked)
        experiment = spread_experiment()
        seeds = asked.seeds or experiment.config.seed
        env_steps = asked.env_steps or experiment.config.env_steps
        episodes = asked.episodes or experiment.config.evaluation.final_episodes
        print("seed\tenv steps\treturn\tsteps/s\tsteps/CPU s", flush=True)
        for seed in seeds:
            boolean_ends = not asked.as_supersuit
            found = train(experiment, seed, env_steps, episodes, asked.time_limits, boolean_ends)
            results.append(found["return"])
            speeds = [f"{env_steps / found[name]:,.0f}" for name in ("seconds", "cpu_seconds")]
            print(f"{seed}\t{env_steps}\t{found['return']:.3f}", *speeds, sep="\t", flush=True)
    except HeadwayError as error:
        print(f"headway: {error}", file=sys.stderr)
        return 2
    if len(results) > 1:
        print(f"mean\t\t{np.mean(results):.3f}\nstd\t\t{np.std(results, ddof=1):.3f}")
    return 0


def _check(asked: argparse.Namespace) -> None:
    """Raise HeadwayError for impossible numbers."""
    for option, number in (("--env-steps", asked.env_steps), ("--episodes", asked.episodes)):
        if number is not None and number < 1:
            raise HeadwayError(f"{option} must be at least 1, not {number}")
    if any(seed < 0 for seed in asked.seeds or ()):
        raise HeadwayError(f"--seeds must be at least 0, not {min(asked.seeds)}")


if __name__ == "__main__":
    sys.exit(main())

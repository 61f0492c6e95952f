"""Environment steps a second of whole trainings, beside what peers gave on a machine of the same kind.

The task of the comparison: a trivially cheap environment of ten agents (Box(4), Discrete(3), shared
reward, 200 steps), MLP 64-64 tanh, PPO with 5 epochs, 4,000 environment steps a batch, one process and
one thread. The peers step a dict-based PettingZoo environment, so the row to compare them with is `dict`.
"""

from dataclasses import replace

from headway_launch.benchmarks.measuring import Task, measure

PEERS = (
    ("RLlib 2.60", 1163, 614),
    ("BenchMARL 1.5", 716, 717),
    ("EPyMARL", 1051, 846),
    ("on-policy (MAPPO)", 1060, 991),
    ("HARL (HAPPO)", 2054, 1598),
    ("Sample Factory (shared, asynchronous)", 2600, 1353),
)
"""Measured once on two cores like those this project is developed on, independent policies, and not
measured again by this command: (name, environment steps a second, a CPU second)."""

BASE = Task(
    env="trivial",
    algo="ippo",
    env_args={},
    algo_args={"epochs": 5, "minibatches": 8},
    copies=20,
    steps=200,
    block=20,
    iterations=12,
)


def report() -> None:
    """Print the table."""
    print("\n## Training: environment steps a second (10 agents, 4,000 steps a batch, PPO with 5 epochs)\n")
    print("| program | environment | policies | steps/s | steps/CPU s | rollouts alone, steps/s |")
    print("|---|---|---|---:|---:|---:|")
    for name, per_second, per_cpu_second in PEERS:
        print(f"| {name}, measured earlier | dict | independent | {per_second:,} | {per_cpu_second:,} | |")
    for dict_based in (True, False):
        for algo in ("ippo", "mappo"):
            for policies in ("independent", "shared"):
                task = replace(
                    BASE, algo=algo, dict_based=dict_based, algo_args={**BASE.algo_args, "policies": policies}
                )
                result = measure([task])[0]
                face = "dict" if dict_based else "batched"
                print(
                    f"| Headway {algo} | {face} | {policies} | {result.per_second:,.0f} "
                    f"| {result.per_cpu_second:,.0f} | {result.collected_per_second:,.0f} |",
                    flush=True,
                )
    _report_two_seeds()
    _report_workers()


def _report_two_seeds() -> None:
    alone = measure([BASE])[0]
    pair = measure([replace(BASE, seed=seed) for seed in (0, 1)])
    together = sum(result.per_second for result in pair)
    print("\nTwo seeds in two processes (ippo, batched, independent):", end=" ")
    print(f"{together:,.0f} steps/s, {together / alone.per_second:.2f} times one alone.", flush=True)


def _report_workers() -> None:
    """Rollout workers pay where the environment does: the dict-based one, and the bus line."""
    for label, task in (
        ("dict-based trivial", replace(BASE, dict_based=True, block=10)),
        ("bus line", replace(BASE, env="bus", copies=8, steps=285, block=4, iterations=8)),
    ):
        one, two = (measure([replace(task, backend="process", workers=workers)])[0] for workers in (1, 2))
        ratio = two.collected_per_second / one.collected_per_second
        print(
            f"Rollouts with two workers against one ({label}): {one.collected_per_second:,.0f} and "
            f"{two.collected_per_second:,.0f} steps/s, {ratio:.2f} times.",
            flush=True,
        )

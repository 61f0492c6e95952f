"""Steps per second of whole trainings, compared with peers on a machine of the same kind and with the speed
of its matrix products.

The task: a trivially cheap environment of ten agents (Box(4), Discrete(3), shared reward, 200 steps), MLP
64-64 tanh, PPO with 5 epochs, 4,000 environment steps per batch, one process and one thread. The peers step a
dict-based PettingZoo environment, so compare them with the rows `dict`. Other algorithms train on the batched
environment with their defaults and one policy per agent: TRPO's critic makes as many passes over a batch as
PPO's, K-FAC's one; algorithms with a replay buffer make 128 steps on 128 transitions per policy and batch.
DDPG, whose actions are Box, trains on `tracking` instead.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from benchmarks.measurement import Measurement, Task, measure
from headway_algos.registry import ENTRIES

PEERS = (
    ("RLlib 2.60", 1163, 614),
    ("BenchMARL 1.5", 716, 717),
    ("EPyMARL", 1051, 846),
    ("on-policy (MAPPO)", 1060, 991),
    ("HARL (HAPPO)", 2054, 1598),
    ("Sample Factory (shared, asynchronous)", 2600, 1353),
)
"""(name, environment steps per second, per CPU second) with independent policies, measured once on two cores
like those of the development machine; this command does not repeat it."""

ITERATION_STEPS, EPOCHS = 4_000, 5
BASE = Task(
    (
        "env=trivial", "algo=ippo", "preset=none", "backend=serial", "algo.policies=independent",
        f"algo.epochs={EPOCHS}", "algo.minibatches=8", "rollout.copies=20", "rollout.steps=200",
        "rollout.block=20", "seed=0",
    ),
    env_steps=10 * ITERATION_STEPS,
)  # fmt: skip

ELSEWHERE = {"ddpg": ("env=tracking", "env.args.agents=10", "env.args.steps=200")}
"""Environments of algorithms that do not support Discrete actions."""

ROUNDS = 3
"""Number of measurements per row, interleaved with the others, because the machine's speed drifts; the table
shows medians."""


AGENTS = 10

LAYERS = ((4, 64), (64, 64))
"""(inputs, outputs) of the hidden layers of IPPO's policies and critics; then 3 outputs, and 1."""


def report() -> None:
    """Print the table."""
    print("\n## Training: environment steps per second (10 agents, 4,000 steps per batch)\n")
    print(f"Headway's rows are medians of {ROUNDS} interleaved runs.\n")
    print("| program | environment | policies | steps/s | steps/CPU s | agent steps/s | rollouts only |")
    print("|---|---|---|---:|---:|---:|---:|")
    for name, per_second, per_cpu_second in PEERS:
        print(
            f"| {name}, measured earlier | dict | independent | {per_second:,} | {per_cpu_second:,} "
            f"| {AGENTS * per_second:,} | |"
        )
    rows = [
        (dict_based, algo, policies)
        for dict_based in (True, False)
        for algo in ("ippo", "mappo")
        for policies in ("independent", "shared")
    ]
    tasks = [
        replace(BASE.having(f"algo={algo}", f"algo.policies={policies}"), dict_based=dict_based)
        for dict_based, algo, policies in rows
    ]
    others = sorted(set(ENTRIES) - {"custom", *(algo for _, algo, _ in rows)})
    rows += [(False, algo, "independent") for algo in others]
    of_ppo = (f"algo.epochs={EPOCHS}", "algo.minibatches=8")
    usual = replace(BASE, words=tuple(word for word in BASE.words if word not in of_ppo))
    tasks += [usual.having(f"algo={algo}", *ELSEWHERE.get(algo, ())) for algo in others]
    for (dict_based, algo, policies), results in zip(rows, interleaved(tasks), strict=True):
        form = "dict" if dict_based else f"batched{', tracking' * (algo in ELSEWHERE)}"
        print(
            f"| Headway {algo} | {form} | {policies} | {median(r.per_second for r in results):,.0f} "
            f"| {median(r.per_cpu_second for r in results):,.0f} "
            f"| {AGENTS * median(r.per_second for r in results):,.0f} "
            f"| {median(r.collected_per_second for r in results):,.0f} |",
            flush=True,
        )
    _report_products()
    _report_two_seeds()
    _report_workers()


def interleaved(tasks: Sequence[Task]) -> list[list[Measurement]]:
    """Return `ROUNDS` measurements of each task, made in the order A B C A B C ..."""
    rounds = [[measure([task])[0] for task in tasks] for _ in range(ROUNDS)]
    return [list(results) for results in zip(*rounds, strict=True)]


def bus_line(copies: int, steps: int) -> Task:
    """Return six counted iterations of the base task on the bus line."""
    sizes = (f"rollout.copies={copies}", f"rollout.steps={steps}", "rollout.block=4")
    return replace(BASE.having("env=bus", *sizes), env_steps=6 * copies * steps)


def flops(epochs: int) -> int:
    """Return the floating-point operations in matrix products per environment step of IPPO.

    Each agent's observation passes forward through policy and critic once, and forward and backward through
    both in every epoch; the backward pass needs a product for the weights and, after the first layer, one
    for the inputs.
    """
    total = 0
    for outputs in (3, 1):
        sizes = [inputs * outs for inputs, outs in (*LAYERS, (LAYERS[-1][1], outputs))]
        total += 2 * sum(sizes) + epochs * 2 * (3 * sum(sizes) - sizes[0])
    return AGENTS * total


def sgemm() -> float:
    """Return the largest speed of torch's products of 64 x 64 by 64 x 256 matrices, FLOP per CPU second."""
    import torch

    torch.set_num_threads(1)
    a, b, c = torch.ones(64, 64), torch.ones(64, 256), torch.empty(64, 256)
    fastest = 0.0
    for _ in range(50):
        began = time.process_time()
        for _ in range(200):
            torch.mm(a, b, out=c)
        fastest = max(fastest, 200 * 2 * 64 * 64 * 256 / (time.process_time() - began))
    return fastest


def _report_products() -> None:
    limits, shares = [], []
    for _ in range(ROUNDS):
        limits.append(sgemm())
        shares.append(flops(EPOCHS) * measure([BASE])[0].per_cpu_second / limits[-1])
    print(
        f"\nThe machine's matrix products (float32, 64 x 64 by 64 x 256, one thread): "
        f"{median(limits) / 1e9:.0f} GFLOP/s. Products alone would let IPPO (batched, independent) train at "
        f"{median(limits) / flops(EPOCHS):,.0f} steps/CPU s, of which it reaches "
        f"{median(shares):.0%}.",
        flush=True,
    )


def _report_two_seeds() -> None:
    ratios, totals = [], []
    for _ in range(ROUNDS):
        alone = measure([BASE])[0]
        pair = measure([BASE.having(f"seed={seed}") for seed in (0, 1)])
        totals.append(sum(result.per_second for result in pair))
        ratios.append(totals[-1] / alone.per_second)
    print("Two seeds in two processes (ippo, batched, independent):", end=" ")
    print(f"{median(totals):,.0f} steps/s, {median(ratios):.2f} times one seed alone.", flush=True)


def _report_workers() -> None:
    """Print the speed-up of rollouts by a second worker, on environments expensive enough to need one."""
    for label, task in (
        ("dict-based trivial, 20 copies", replace(BASE.having("rollout.block=10"), dict_based=True)),
        ("bus line, 8 copies", bus_line(8, 285)),
        ("bus line, 32 copies", bus_line(32, 143)),
    ):
        pairs = [task.having("backend=process", f"backend.workers={workers}") for workers in (1, 2)]
        one, two = interleaved(pairs)
        ratio = median(b.collected_per_second / a.collected_per_second for a, b in zip(one, two, strict=True))
        print(
            f"Rollouts with two workers against one ({label}): "
            f"{median(r.collected_per_second for r in one):,.0f} and "
            f"{median(r.collected_per_second for r in two):,.0f} steps/s, {ratio:.2f} times.",
            flush=True,
        )

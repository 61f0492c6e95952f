"""Time of minibatch steps of PPO policies and critics, by compiled kernels and by torch."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from headway.contracts import Discrete, EnvSpec, generator

ROUNDS, OBSERVED, ROWS_PER_ROUND = 5, 20, 25_600


@dataclass(frozen=True)
class Case:
    """Number and size of networks, and rows per minibatch."""

    seeds: int
    hidden: tuple[int, ...]
    rows: int


CASES = [
    Case(seeds, hidden, rows)
    for seeds in (1, 5)
    for hidden, rows in (
        ((32, 32, 32), 128),
        ((64, 64), 64),
        ((64, 64), 500),
        ((64, 64), 4000),
        ((256, 256), 1000),
    )
]


def learners(case: Case) -> tuple[list[Callable[[], object]], int]:
    """Return two functions, which run all minibatch steps of the policies and of the critics, and the number
    of these steps."""
    import torch

    from headway_algos.batches.layout import Layout
    from headway_algos.batches.policy_batch import PolicyBatch
    from headway_algos.config import ModelConfig
    from headway_algos.grouping import Grouping
    from headway_algos.networks.actor import Actor
    from headway_algos.on_policy.critics.critic_inputs import LocalInputs
    from headway_algos.on_policy.critics.estimate import CriticEstimate
    from headway_algos.on_policy.critics.return_regression import ReturnNetworks, ReturnRegression
    from headway_algos.on_policy.updates.gradient_update import ppo_update
    from headway_algos.registry import configure

    steps = ROWS_PER_ROUND // case.rows
    rows, device = steps * case.rows, torch.device("cpu")
    spec = EnvSpec("made", ("a",), OBSERVED, Discrete(3))
    model = ModelConfig(hidden=case.hidden)
    config = configure("ippo", policies="shared", model=model, epochs=1, minibatches=steps)
    seeds, grouping = tuple(range(case.seeds)), Grouping.of("shared", spec)
    layout, random = Layout(grouping, case.seeds, device, torch.float32), np.random.default_rng(0)
    actor = Actor(config.model, spec, seeds, 1, torch.float32)
    observations = torch.from_numpy(random.normal(size=(case.seeds, rows, OBSERVED)).astype(np.float32))
    actions = torch.from_numpy(random.integers(3, size=(case.seeds, rows)))
    with torch.no_grad():
        log_probs = actor(observations, None).log_prob(actions)
    advantages = torch.from_numpy(random.normal(size=(case.seeds, rows)).astype(np.float32))
    here = np.ones((case.seeds, rows), np.bool_)
    batch = PolicyBatch(observations, None, actions, log_probs, here)
    update = ppo_update(actor, config, layout)
    view = LocalInputs(config, spec, grouping)
    regression = ReturnRegression(ReturnNetworks(config, view, 1, seeds, layout), seeds)
    returns = random.normal(size=(rows, case.seeds, 1))
    estimate = CriticEstimate(returns, returns, returns, here.T[..., None], observations, hidden_states=None)
    return [
        lambda: update.improve(batch, advantages, [generator(seed, "benchmark") for seed in seeds]),
        lambda: regression.fit(estimate, 0),
    ], steps


def measured(case: Case) -> list[tuple[float, float]]:
    """Return the time per step by torch and by compiled kernels, microseconds, for policies and for critics:
    minimum over interleaved rounds."""
    from headway_algos.optim import fast_path

    least = np.full((2, 2), np.inf)
    learn, steps = learners(case)
    try:
        for place in range(ROUNDS + 1):
            for column, compiled in enumerate((False, True)):
                fast_path.ENABLED = compiled
                for part, run in enumerate(learn):
                    began = time.process_time()
                    run()
                    if place > 0:
                        least[part, column] = min(least[part, column], time.process_time() - began)
    finally:
        fast_path.ENABLED = True
    return [(by_torch, ours) for by_torch, ours in (least / steps * 1e6).tolist()]


def report() -> None:
    """Print the table."""
    import torch

    print("\n## Minibatch steps\n")
    print("Torch computes the gradients; its steps of Adam and its tanh are compiled too.\n")
    print("| networks | hidden layers | rows | policies: torch, us | compiled, us | critics: torch, us "
          "| compiled, us |")  # fmt: skip
    print("|---:|---|---:|---:|---:|---:|---:|")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    for case in CASES:
        cells = [f"{us:.0f}" for pair in measured(case) for us in pair]
        hidden = "-".join(map(str, case.hidden))
        print(f"| {case.seeds} | {hidden} | {case.rows} | {' | '.join(cells)} |", flush=True)
    torch.set_num_threads(threads)

"""Time of a learner's updates on a GPU and on one core of a CPU, for stacks of seeds and sizes of networks.

The task is that of `training`: IPPO with one policy for each of ten agents, so that a stack of S seeds trains
10 S policies and as many critics at once.
"""

from dataclasses import replace

from benchmarks.measurement import measure
from benchmarks.training import BASE, ITERATION_STEPS

UPDATES = 3
"""Counted updates of each training."""

CASES = ((1, 64), (10, 64), (1, 256))
"""(seeds, units of each of two hidden layers)."""


def report() -> None:
    """Print the table, or why there is none."""
    import torch

    print("\n## Updates on a GPU\n")
    if not torch.cuda.is_available():
        print("torch finds no GPU; nothing is measured.")
        return
    print(f"{torch.cuda.get_device_name()}; means of {UPDATES} updates.\n")
    print("| seeds | hidden layers | one CPU core, s | GPU, s | CPU / GPU |")
    print("|---:|---|---:|---:|---:|")
    for stack, width in CASES:
        seeds = ",".join(map(str, range(stack)))
        words = (f"algo.model.hidden=[{width},{width}]", f"seed={seeds}", f"backend.stack={stack}")
        task = replace(BASE.having(*words), env_steps=UPDATES * ITERATION_STEPS)
        on_cpu, on_gpu = (
            measure([task.having(f"device={device}")])[0].learn_s / UPDATES for device in ("cpu", "cuda")
        )
        print(
            f"| {stack} | {width}-{width} | {on_cpu:.2f} | {on_gpu:.2f} | {on_cpu / on_gpu:.1f} |", flush=True
        )

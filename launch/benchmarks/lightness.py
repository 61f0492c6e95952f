"""Start-up time and memory of workers, and start-up time of the command line."""

import multiprocessing
import os
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

from headway.registry import env_entry

POLICY = "headway_algos.acting.mlp"
"""Module of the acting policy that most algorithms use."""


def _worker(connection: Connection) -> None:
    import psutil

    entry = env_entry("bus")
    prepared = connection.recv()
    env = entry.make(prepared, 4)
    memory = psutil.Process().memory_full_info()
    connection.send((memory.rss, memory.uss, "torch" in sys.modules))
    connection.recv()
    del env


def report() -> None:
    """Print the measurements."""
    print("\n## Lightness\n")
    entry = env_entry("bus")
    prepared = entry.prepare(entry.config())
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["headway.rollout.workers.worker", *entry.preload, POLICY])
    for label in ("the first worker (starts the forkserver)", "a further worker"):
        ours, theirs = context.Pipe()
        began = time.monotonic()
        process = context.Process(target=_worker, args=(theirs,))
        process.start()
        ours.send(prepared)
        resident, own, has_torch = ours.recv()
        seconds = time.monotonic() - began
        print(
            f"- {label}, with the bus environment: ready in {seconds:.2f} s, {resident / 2**20:.0f} MB "
            f"resident, {own / 2**20:.0f} MB of it not shared with the forkserver, "
            f"torch {'imported' if has_torch else 'not imported'}",
            flush=True,
        )
        ours.send(None)
        process.join()
    command = str(Path(sys.executable).with_name("headway"))
    times = []
    for _ in range(5):
        began = time.monotonic()
        subprocess.run([command, "--help"], check=True, stdout=subprocess.DEVNULL, env=dict(os.environ))
        times.append(time.monotonic() - began)
    print(f"- `headway --help`: {sorted(times)[2]:.2f} s (median of 5)")

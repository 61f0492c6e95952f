"""The whole city: agent-ticks a second of its environment, and what training it holds in memory and takes."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from headway_launch.benchmarks import kernel
from headway_launch.benchmarks.measuring import first_part, measure
from headway_launch.composing import compose

EXPERIMENT = "bus_city"
ITERATIONS = 8
_EVERY_S = 0.25


def report() -> None:
    """Print both tables."""
    print("\n## The city: agent-ticks a second on one core\n")
    kernel.report_rates({"city": 2})
    experiment = compose([f"experiment={EXPERIMENT}"])
    env_steps = ITERATIONS * experiment.config.rollout.copies * experiment.config.rollout.steps
    trained = measure([first_part(experiment, env_steps)])[0]
    minutes = experiment.config.env_steps / trained.per_cpu_second / 60.0
    print(f"\n## Training the city: one seed of {EXPERIMENT}\n")
    print("| steps/CPU s | budget, steps | CPU minutes, evaluations aside | memory of the session, MB |")
    print("|---:|---:|---:|---:|")
    print(
        f"| {trained.per_cpu_second:.0f} | {experiment.config.env_steps:,} | {minutes:.1f} "
        f"| {_session_mb(env_steps):.0f} |"
    )
    print("\nMemory: all processes of `headway run`, pages that they share counted once, at most.")


def _session_mb(env_steps: int) -> float:
    """The most memory that a session holds which trains one seed and evaluates it."""
    with tempfile.TemporaryDirectory(prefix="headway-benchmark-") as folder:
        command = [
            sys.executable, "-m", "headway_launch", "run", f"experiment={EXPERIMENT}", "seed=0",
            f"env_steps={env_steps}", f"evaluation.every={env_steps}", "evaluation.episodes=1",
            "evaluation.final_episodes=1", "evaluation.rules=[]", f"store.root={Path(folder) / 'store'}",
        ]  # fmt: skip
        log = Path(folder) / "log"
        with log.open("w") as told:
            session = subprocess.Popen(command, stdout=told, stderr=told)
        most = 0.0
        while session.poll() is None:
            most = max(most, tree_mb(session.pid))
            time.sleep(_EVERY_S)
        if session.returncode:
            raise SystemExit(f"benchmark: the measured session failed: {log.read_text()}")
    return most


def tree_mb(process_id: int) -> float:
    """Proportional set size of a process and all that came of it, MB; 0 where it has ended."""
    total = 0
    try:
        parent = psutil.Process(process_id)
        members = [parent, *parent.children(recursive=True)]
    except psutil.NoSuchProcess:
        return 0.0
    for member in members:
        try:
            total += member.memory_full_info().pss
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return total / 2**20

"""The whole city: agent-ticks a second of its environment, and what training it holds in memory and takes."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from benchmarks import kernel
from benchmarks.measurement import first_part, measure
from headway_launch.experiments.compose import compose

EXPERIMENT = "bus_city"
ITERATIONS = 8
_EVERY_S = 0.25


def report() -> None:
    """Print the three tables."""
    print("\n## The city: agent-ticks a second on one core\n")
    kernel.report_rates({"city": 2})
    experiment = compose([f"experiment={EXPERIMENT}"])
    env_steps = ITERATIONS * experiment.config.rollout.copies * experiment.config.rollout.steps
    trained = measure([first_part(experiment, env_steps)])[0]
    minutes = experiment.config.env_steps / trained.per_cpu_second / 60.0
    print(f"\n## Training the city: one seed of {EXPERIMENT}\n")
    print("| steps/CPU s | budget, steps | CPU minutes, evaluations aside |")
    print("|---:|---:|---:|")
    print(f"| {trained.per_cpu_second:.0f} | {experiment.config.env_steps:,} | {minutes:.1f} |")
    held = _session_mb(env_steps)
    print(f"\n| memory, MB: {' | '.join(held)} | total |")
    print(f"|{'---:|' * (len(held) + 1)}")
    print(f"| {' | '.join(f'{mb:.0f}' for mb in held.values())} | {sum(held.values()):.0f} |")
    print("\nMemory: of `headway run` when it holds most, pages that processes share counted once.")


def _session_mb(env_steps: int) -> dict[str, float]:
    """What each part of a session holds that trains one seed and evaluates it, MB, when all hold the most."""
    with tempfile.TemporaryDirectory(prefix="headway-benchmark-") as folder:
        command = [
            sys.executable, "-m", "headway_launch", "run", f"experiment={EXPERIMENT}", "seed=0",
            f"env_steps={env_steps}", f"evaluation.every={env_steps}", "evaluation.episodes=1",
            "evaluation.final_episodes=1", "evaluation.rules=[]", f"store.root={Path(folder) / 'store'}",
        ]  # fmt: skip
        log = Path(folder) / "log"
        with log.open("w") as told:
            session = subprocess.Popen(command, stdout=told, stderr=told)
        most: dict[str, float] = {}
        while session.poll() is None:
            most = max(most, parts_mb(session.pid), key=lambda parts: sum(parts.values()))
            time.sleep(_EVERY_S)
        if session.returncode:
            raise SystemExit(f"benchmark: the measured session failed: {log.read_text()}")
    return most


def parts_mb(process_id: int) -> dict[str, float]:
    """Proportional set size of a session and of all that came of it, MB: its own process, learners, the
    workers, the server that these are forked from, and others; 0 where it has ended."""
    parts = dict.fromkeys(("session", "learner", "workers", "fork server", "others"), 0.0)
    try:
        session = psutil.Process(process_id)
        members = [session, *session.children(recursive=True)]
    except psutil.NoSuchProcess:
        return parts
    servers: set[int] = set()
    for member in members:  # parents come before their children
        try:
            part = "session" if member == session else _part(member, servers)
            parts[part] += member.memory_full_info().pss / 2**20
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return parts


def _part(member: psutil.Process, servers: set[int]) -> str:
    """By the command of `multiprocessing` that a process was started with; what a server has forked, has
    the server's. Fork servers met are added to `servers`."""
    command = " ".join(member.cmdline())
    if "multiprocessing.spawn" in command:
        return "learner"
    if "multiprocessing.forkserver" not in command:
        return "others"
    if member.ppid() in servers:
        return "workers"
    servers.add(member.pid)
    return "fork server"

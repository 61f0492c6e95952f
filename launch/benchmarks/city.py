"""Speed of the whole city's environment, and memory of training on it."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from benchmarks import kernel
from headway_launch.experiments.compose import compose

EXPERIMENT = "bus_city"
ITERATIONS = 8
_EVERY_S = 0.25


def report() -> None:
    """Print the two tables."""
    print("\n## The city: agent-ticks per second on one core\n")
    kernel.report_rates({"city": 2})
    rollout = compose([f"experiment={EXPERIMENT}"]).config.rollout
    env_steps = ITERATIONS * rollout.copies * rollout.steps
    memory_mb = _session_mb(env_steps)
    print(f"\n## Training the city: one seed of {EXPERIMENT}\n")
    print(f"| memory, MB: {' | '.join(memory_mb)} | total |")
    print(f"|{'---:|' * (len(memory_mb) + 1)}")
    print(f"| {' | '.join(f'{mb:.0f}' for mb in memory_mb.values())} | {sum(memory_mb.values()):.0f} |")
    print("\nMemory: peak of `headway run`, pages shared between processes counted once.")


def _session_mb(env_steps: int) -> dict[str, float]:
    """Return the memory of each part of a session at its total peak, MB; it trains and evaluates one seed."""
    with tempfile.TemporaryDirectory(prefix="headway-benchmark-") as folder:
        command = [
            sys.executable, "-m", "headway_launch", "run", f"experiment={EXPERIMENT}", "seed=0",
            f"env_steps={env_steps}", f"evaluation.every={env_steps}", "evaluation.episodes=1",
            "evaluation.final_episodes=1", "evaluation.rules=[]", f"store.root={Path(folder) / 'store'}",
        ]  # fmt: skip
        log = Path(folder) / "log"
        with log.open("w") as output:
            session = subprocess.Popen(command, stdout=output, stderr=output)
        peak: dict[str, float] = {}
        while session.poll() is None:
            peak = max(peak, parts_mb(session.pid), key=lambda parts: sum(parts.values()))
            time.sleep(_EVERY_S)
        if session.returncode:
            raise SystemExit(f"benchmark: the measured session failed: {log.read_text()}")
    return peak


def parts_mb(process_id: int) -> dict[str, float]:
    """Return the proportional set sizes of a session's processes by part, MB: session process, learners,
    workers, fork server, others; 0 if the session has ended."""
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
    """Return the part of a process, from its `multiprocessing` command line. Forked workers have that of
    their fork server; fork servers found are added to `servers`."""
    command = " ".join(member.cmdline())
    if "multiprocessing.spawn" in command:
        return "learner"
    if "multiprocessing.forkserver" not in command:
        return "others"
    if member.ppid() in servers:
        return "workers"
    servers.add(member.pid)
    return "fork server"

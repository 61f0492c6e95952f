"""Trial: a repeatedly killed study gives the curves and tables of an uninterrupted one, without duplicates.

    python -m tests.trials.killed_study --root FOLDER --seeds 10

sweeps three algorithms over the bus line twice. The second sweep is killed at random points, each time
another process by another signal, and continued alternately by `headway resume --study` and the same sweep.
Prints the differences and exits with code 1 if there are any.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from headway.store.index import RunIndex
from headway.store.tracking.sync import sync_each
from tests.trials.same_study import differences

STUDY = "killed"
BASE = (
    "env=bus", "algo=ippo,mappo,ia2c", f"study={STUDY}", "evaluation.episodes=2",
    "evaluation.final_episodes=4", "evaluation.rules=[even_headway]", "store.checkpoint_every=5",
)  # fmt: skip
_TIMEOUT_S = 3600.0
_ATTEMPTS = 5
_POLL_S = 0.1


@dataclass(frozen=True)
class Kill:
    """Process of a session and the signal sent to it; `then` ends the session if that does not."""

    victim: str
    number: signal.Signals
    then: signal.Signals | None = None


KILLS = (
    Kill("session", signal.SIGKILL),
    Kill("training process", signal.SIGKILL, then=signal.SIGTERM),
    Kill("rollout worker", signal.SIGTERM, then=signal.SIGKILL),
    Kill("session", signal.SIGTERM),
    Kill("rollout worker", signal.SIGKILL, then=signal.SIGTERM),
    Kill("process group", signal.SIGKILL),
    Kill("fork server", signal.SIGKILL, then=signal.SIGTERM),
)


def main() -> None:
    """Run the trial; see the module."""
    parser = argparse.ArgumentParser(
        description="Kill a study repeatedly, and compare it with an uninterrupted one."
    )
    parser.add_argument("--root", type=Path, required=True, help="an empty folder for the two stores")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", default="60000", help="environment steps of each seed")
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--chance", type=int, default=0, help="seed of the random points")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="further overrides of the sweep")
    arguments = parser.parse_args()
    sweep = [*BASE, f"seed=0..{arguments.seeds - 1}", f"env_steps={arguments.steps}", *arguments.overrides]
    found = trial(arguments.root, sweep, arguments.kills, random.Random(arguments.chance))
    print(
        "\n".join(found) or "the killed study equals the uninterrupted one: curves, tables, store and MLflow"
    )
    sys.exit(1 if found else 0)


def trial(root: Path, sweep: Sequence[str], kills: int, chance: random.Random) -> list[str]:
    """Return the differences between a study killed `kills` times and an uninterrupted one."""
    whole, killed = root / "whole", root / "killed"
    began = time.monotonic()
    print("uninterrupted ...", flush=True)
    table = _run_to_end(["sweep", *sweep, f"store.root={whole}"])
    print(f"{time.monotonic() - began:.0f} s; killed ...", flush=True)
    total = _iterations(whole)
    commands = (
        ["sweep", *sweep, f"store.root={killed}"],
        ["resume", "--study", STUDY, "--store", str(killed)],
    )
    points = sorted(chance.uniform(0.05, 0.9) for _ in range(kills))
    kills_done = 0
    for place, point in enumerate(points):
        kill = KILLS[place % len(KILLS)]
        was_alive = _strike(commands[place % 2], killed, int(point * total), kill, chance)
        kills_done += was_alive
        if was_alive:
            sync_each(killed)  # MLflow has a part of each curve when the next session goes on
        event = f"{kill.victim} by {kill.number.name}" if was_alive else "the session had already ended"
        print(f"{event} at {_iterations(killed)} of {total} iterations", flush=True)
    if kills and not kills_done:
        raise SystemExit(
            "every session ended before it was killed, so nothing was tested: set --steps higher"
        )
    after = _run_to_end(commands[kills % 2])
    for store in (whole, killed):
        sync_each(store)  # nothing is sent twice
    if results_of(after) != results_of(table):
        return [f"tables differ:\n{table}\n{after}", *differences(whole, killed)]
    return differences(whole, killed)


def _strike(command: Sequence[str], root: Path, iterations: int, kill: Kill, chance: random.Random) -> bool:
    """Start a session and kill it at a random moment after `iterations` are stored; return whether it was
    still alive then."""
    with subprocess.Popen(_headway(command), stdout=subprocess.DEVNULL, start_new_session=True) as session:
        processes: list[psutil.Process] = []
        deadline = time.monotonic() + _TIMEOUT_S
        while session.poll() is None and (_iterations(root) < iterations or not processes):
            if time.monotonic() > deadline:
                raise SystemExit("the study makes no progress")
            time.sleep(_POLL_S)
            processes = processes_of(session.pid, kill.victim)
        time.sleep(chance.uniform(0.0, 1.0))
        was_alive, descendants = False, _children(session.pid) if session.poll() is None else []
        for process in (processes_of(session.pid, kill.victim) or processes)[:1]:
            was_alive = session.poll() is None and _send(process, kill)
        if kill.then is not None and session.poll() is None:
            time.sleep(chance.uniform(0.2, 2.0))
            was_alive |= session.poll() is None
            session.send_signal(kill.then)
        session.wait(_TIMEOUT_S)
        _, left = psutil.wait_procs(descendants, timeout=60)
        if left:
            raise SystemExit(f"{len(left)} processes outlived their session")
    return was_alive


def _run_to_end(command: Sequence[str]) -> str:
    """Run a command, repeatedly if runs fail, and return its last table."""
    for _ in range(_ATTEMPTS):
        done = subprocess.run(_headway(command), stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode == 0:
            return done.stdout
    raise SystemExit(f"headway {' '.join(command)} ends with code {done.returncode}")


def results_of(table: str) -> list[list[str]]:
    """Return of each cell its name, number of finished runs, reward, deviation and AUC, without costs."""
    return [line.split("\t")[:5] for line in table.splitlines()]


def _headway(command: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "headway_launch", *command]


def processes_of(session: int, victim: str) -> list[psutil.Process]:
    """Return the live processes of a kind, see `Kill.victim`, of the session with this process id."""
    if victim in ("session", "process group"):
        return [psutil.Process(session)] if psutil.pid_exists(session) else []
    trainers = [child for child in _children(session, recursive=False) if "spawn_main" in _command(child)]
    if victim == "training process":
        return trainers
    # A worker is a child of the fork server, which is one of the training process.
    servers = [
        child
        for trainer in trainers
        for child in _children(trainer.pid, recursive=False)
        if "forkserver" in _command(child)
    ]
    if victim == "fork server":
        return servers
    return [worker for server in servers for worker in _children(server.pid, recursive=False)]


def _children(pid: int, recursive: bool = True) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=recursive)
    except psutil.NoSuchProcess:
        return []


def _command(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return ""


def _send(process: psutil.Process, kill: Kill) -> bool:
    """Send the signal; return whether the process existed."""
    try:
        if kill.victim == "process group":
            os.killpg(process.pid, kill.number)
        else:
            process.send_signal(kill.number)
    except (psutil.NoSuchProcess, ProcessLookupError):  # has just ended
        return False
    return True


def _iterations(root: Path) -> int:
    return sum(row.iterations for row in RunIndex(root).rows(STUDY)) if root.exists() else 0


if __name__ == "__main__":
    main()

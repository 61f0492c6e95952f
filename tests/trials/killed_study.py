"""A study that is killed again and again ends as one that never was: the same curves, the same tables, and in
the store everything once.

    python -m tests.trials.killed_study --root FOLDER --seeds 10

sweeps three algorithms over the bus line twice. The second time a signal ends it at random points, each time
another process by another signal; it is gone on with by `headway resume --study` and by the same sweep in
turn. Prints what differs, and ends with exit code 1 if anything does.
"""

import argparse
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from headway.store import RunIndex, sync_each
from tests.trials.same_study import differences

STUDY = "killed"
BASE = (
    "env=bus",
    "algo=ippo,mappo,ia2c",
    f"study={STUDY}",
    "evaluation.episodes=2",
    "evaluation.final_episodes=4",
    "evaluation.rules=[even_headway]",
    "store.checkpoint_every=5",
)
_PATIENCE_S = 3600.0
_ATTEMPTS = 5
_POLL_S = 0.1


@dataclass(frozen=True)
class Blow:
    """One process of a session, and the signal it gets; `then` ends the session where that does not."""

    victim: str
    number: signal.Signals
    then: signal.Signals | None = None


BLOWS = (
    Blow("session", signal.SIGKILL),
    Blow("training process", signal.SIGKILL, then=signal.SIGTERM),
    Blow("rollout worker", signal.SIGTERM, then=signal.SIGKILL),
    Blow("session", signal.SIGTERM),
    Blow("rollout worker", signal.SIGKILL, then=signal.SIGTERM),
)


def main() -> None:
    """Run the trial; see the module."""
    parser = argparse.ArgumentParser(
        description="Kill a study again and again, and compare it with one unkilled."
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
    print("\n".join(found) or "the killed study is the unkilled one: curves, tables, store and MLflow")
    sys.exit(1 if found else 0)


def trial(root: Path, sweep: Sequence[str], kills: int, chance: random.Random) -> list[str]:
    """What differs between a study killed so often and one unkilled; empty if nothing does."""
    whole, killed = root / "whole", root / "killed"
    began = time.monotonic()
    print("unkilled ...", flush=True)
    table = _to_the_end(["sweep", *sweep, f"store.root={whole}"])
    print(f"{time.monotonic() - began:.0f} s; killed ...", flush=True)
    total = _iterations(whole)
    going_on = (
        ["sweep", *sweep, f"store.root={killed}"],
        ["resume", "--study", STUDY, "--store", str(killed)],
    )
    points = sorted(chance.uniform(0.05, 0.9) for _ in range(kills))
    landed = 0
    for place, point in enumerate(points):
        blow = BLOWS[place % len(BLOWS)]
        struck = _strike(going_on[place % 2], killed, int(point * total), blow, chance)
        landed += struck
        fallen = f"{blow.victim} by {blow.number.name}" if struck else "the session had ended by itself"
        print(f"{fallen} at {_iterations(killed)} of {total} iterations", flush=True)
    if kills and not landed:
        raise SystemExit("every session ended before its blow fell, so nothing was tried: give more --steps")
    after = _to_the_end(going_on[kills % 2])
    for store in (whole, killed):
        sync_each(store)  # what a busy machine's session had no time to send; nothing is sent twice
    if _figures(after) != _figures(table):
        return [f"tables differ:\n{table}\n{after}", *differences(whole, killed)]
    return differences(whole, killed)


def _strike(command: Sequence[str], root: Path, iterations: int, blow: Blow, chance: random.Random) -> bool:
    """Start a session and end it by a blow, at a random moment after so many iterations are durable.
    Whether it still lived when a blow fell."""
    with subprocess.Popen(_headway(command), stdout=subprocess.DEVNULL, start_new_session=True) as session:
        processes: list[psutil.Process] = []
        deadline = time.monotonic() + _PATIENCE_S
        while session.poll() is None and (_iterations(root) < iterations or not processes):
            if time.monotonic() > deadline:
                raise SystemExit("the study does not come on")
            time.sleep(_POLL_S)
            processes = _processes(session.pid, blow.victim)
        time.sleep(chance.uniform(0.0, 1.0))
        struck, everyone = False, _children(session.pid) if session.poll() is None else []
        for process in (_processes(session.pid, blow.victim) or processes)[:1]:
            struck = session.poll() is None and _send(process, blow.number)
        if blow.then is not None and session.poll() is None:
            time.sleep(chance.uniform(0.2, 2.0))
            struck |= session.poll() is None
            session.send_signal(blow.then)
        session.wait(_PATIENCE_S)
        _, left = psutil.wait_procs(everyone, timeout=60)
        if left:
            raise SystemExit(f"{len(left)} processes outlived their session")
    return struck


def _to_the_end(command: Sequence[str]) -> str:
    """Run a command, again where runs have failed; its last table."""
    for _ in range(_ATTEMPTS):
        done = subprocess.run(_headway(command), stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode == 0:
            return done.stdout
    raise SystemExit(f"headway {' '.join(command)} ends with code {done.returncode}")


def _figures(table: str) -> list[list[str]]:
    """Of each cell: its name, how many have finished, reward, deviation and AUC; not what it cost."""
    return [line.split("\t")[:5] for line in table.splitlines()]


def _headway(command: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "headway_launch", *command]


def _processes(session: int, victim: str) -> list[psutil.Process]:
    if victim == "session":
        return [psutil.Process(session)] if psutil.pid_exists(session) else []
    trainers = [child for child in _children(session, recursive=False) if "spawn_main" in _command(child)]
    if victim == "training process":
        return trainers
    # A worker is a child of the fork server, which is one of the training process.
    return [
        worker
        for trainer in trainers
        for server in _children(trainer.pid, recursive=False)
        if "forkserver" in _command(server)
        for worker in _children(server.pid, recursive=False)
    ]


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


def _send(process: psutil.Process, number: signal.Signals) -> bool:
    """Whether there was anybody to send it to."""
    try:
        process.send_signal(number)
    except psutil.NoSuchProcess:  # it has just finished
        return False
    return True


def _iterations(root: Path) -> int:
    return sum(row.iterations for row in RunIndex(root).rows(STUDY)) if root.exists() else 0


if __name__ == "__main__":
    main()

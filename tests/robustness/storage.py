"""Disks that fill or become read-only, lost servers, sweeps at once: nothing is lost."""

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from tests.robustness.kills import BASE, STUDIES, STUDY, compared, undisturbed
from tests.robustness.outcomes import FAILURES, Outcome, Scale, Tally
from tests.robustness.sessions import Session, session_outcome
from tests.support.mlflow_server import free_port, start_server

SWEEP = [*STUDIES["workers"], *BASE]
_ATTEMPTS = 4

# Scripts run a command line ("$@") in a mount namespace of its own; `runs` is the store.
_FULL_DISK = """
mount -t tmpfs -o size=300m tmpfs runs || exit 99
"$@" & session=$!
sleep {delay}
head -c 1G /dev/zero > runs/filler 2> /dev/null
truncate -s -{slack} runs/filler
[ {pause} = 0 ] || { sleep {pause}; rm runs/filler; }
wait $session; code=$?
rm -f runs/filler
cp -a runs kept
exit $code
"""
_READ_ONLY = """
mount --bind runs runs || exit 99
"$@" & session=$!
sleep {delay}
tries=0
until mount -o remount,ro,bind runs 2> /dev/null || [ $tries = 200 ]
do tries=$((tries + 1)); sleep 0.02; done
[ {pause} = 0 ] || { sleep {pause}; mount -o remount,rw,bind runs; }
wait $session
"""
_SIZE_LIMIT = 'ulimit -f {blocks}; exec "$@"'


@dataclass(frozen=True)
class End:
    """How a disturbed sweep ended."""

    outcome: Outcome
    how: str
    """Details, for the user."""
    words: tuple[str, ...] = ()
    """Overrides that the sweep needs to be completed."""


Fault = Callable[[Path, random.Random, ExitStack], End]
"""Runs a disturbed sweep with a store `folder`/runs; what its completion needs is kept on the stack."""


def campaign(scale: Scale, seed: int, folder: Path) -> list[Tally]:
    """Disturb the storage of sweeps, complete them, and compare them with an undisturbed one."""
    faults = {name: fault for name, fault in FAULTS.items() if may_mount() or name not in _MOUNTING}
    table = undisturbed(SWEEP, folder / "whole")
    tallies = {name: Tally(f"storage: {name}") for name in faults}
    for number in range(scale.storage):
        name = list(faults)[number % len(faults)]
        outcome, how = disturbed(
            faults[name], random.Random(f"{seed} {number}"), folder / str(number), table,
            folder / "whole/runs",
        )  # fmt: skip
        tallies[name].add(outcome, f"case {number} of seed {seed}: {how}" if outcome in FAILURES else "")
        shutil.rmtree(folder / str(number))
    return list(tallies.values())


def disturbed(
    fault: Fault, chance: random.Random, folder: Path, table: str, whole: Path
) -> tuple[Outcome, str]:
    """Run one case: the fault, completion of the study, comparison; return the outcome and details."""
    (folder / "runs").mkdir(parents=True)
    with ExitStack() as kept:
        end = fault(folder, chance, kept)
        if (folder / "kept").exists():
            (folder / "runs").rmdir()
            (folder / "kept").rename(folder / "runs")
        found = [] if end.outcome in FAILURES else _completed(folder, table, whole, chance, end.words)
    return (Outcome.LOST, f"{end.how}; {found}") if found else (end.outcome, end.how)


def may_mount() -> bool:
    """Return whether this machine allows mounts in a separate namespace."""
    done = subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True)
    return done.returncode == 0


def _completed(
    folder: Path, table: str, whole: Path, chance: random.Random, words: Sequence[str]
) -> list[str]:
    """Complete a study and send it to MLflow; return the differences from the undisturbed one."""
    commands = [["sweep", *SWEEP, *words]]
    if chance.random() < 0.5:
        commands.insert(0, ["resume", "--study", STUDY])
    finished, errors = "", ""
    for attempt in range(_ATTEMPTS):
        with Session(commands[min(attempt, len(commands) - 1)], folder) as session:
            code, finished, errors = session.end(), session.out, session.err
        if code == 0 and attempt >= len(commands) - 1:
            break
    else:
        return [f"it does not finish: {errors.splitlines()[-4:]}"]
    with Session(["sync"], folder) as session:
        if session.end() != 0 or "Traceback" in session.err:
            return [f"headway sync fails: {session.err}"]
    return compared(finished, folder / "runs", table, whole)


def _ended(session: Session, how: str, words: Sequence[str] = ()) -> End:
    code = session.end()
    details = f"{how}; code {code}: {' | '.join(session.err.splitlines()[-6:])}"
    return End(session_outcome(code, session.err), details, tuple(words))


def _in_namespace(script: str, folder: Path, **values: object) -> End:
    for name, value in values.items():
        script = script.replace(f"{{{name}}}", str(value))
    with Session(["sweep", *SWEEP], folder, before=["unshare", "-rm", "sh", "-c", script, "sh"]) as session:
        return _ended(session, f"{values}")


def _full_disk(folder: Path, chance: random.Random, kept: ExitStack) -> End:
    pause = chance.choice([0, 0, chance.uniform(0, 10)])
    slack = chance.choice([0, 1, 4, 16, 64, 256]) * 1024
    return _in_namespace(_FULL_DISK, folder, delay=_moment(chance), pause=pause, slack=slack)


def _read_only(folder: Path, chance: random.Random, kept: ExitStack) -> End:
    pause = chance.choice([0, 0, chance.uniform(0, 10)])
    return _in_namespace(_READ_ONLY, folder, delay=_moment(chance), pause=pause)


def size_limit(folder: Path, chance: random.Random, kept: ExitStack, blocks: int | None = None) -> End:
    """Limit the size of files, in blocks of 512 bytes; None: at random."""
    blocks = blocks or round(2 ** chance.uniform(3, 12))
    script = _SIZE_LIMIT.replace("{blocks}", str(blocks))
    with Session(["sweep", *SWEEP], folder, before=["sh", "-c", script, "sh"]) as session:
        return _ended(session, f"files of {blocks} blocks")


def _lost_server(folder: Path, chance: random.Random, kept: ExitStack) -> End:
    """The server keeps its database where a store has its own, so that the studies can be compared."""
    port, delay, pause = free_port(), _moment(chance), chance.uniform(0, 10)
    server = start_server(folder / "runs", port)
    words = [f"store.tracking_uri=http://127.0.0.1:{port}"]
    with Session(["sweep", *SWEEP, *words], folder) as session:
        try:
            time.sleep(delay)
        finally:
            _kill(server)
        time.sleep(pause)
        kept.callback(_kill, start_server(folder / "runs", port))
        return _ended(session, f"server lost after {delay:.1f} s for {pause:.1f} s", words)


def _kill(server: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGKILL)
    server.wait()


def _sweeps_at_once(folder: Path, chance: random.Random, kept: ExitStack) -> End:
    with ExitStack() as stack:
        sessions = []
        for _ in range(chance.choice([2, 2, 3])):
            sessions.append(stack.enter_context(Session(["sweep", *SWEEP], folder)))
            time.sleep(chance.choice([0.0, chance.uniform(0, 6)]))
        ends = [_ended(session, "sweep") for session in sessions]
    worst = [end.outcome for end in ends if end.outcome in FAILURES] or [ends[0].outcome]
    return End(worst[0], "; ".join(end.how for end in ends))


def _moment(chance: random.Random) -> float:
    """Return a moment of the session: start, training or end, s."""
    return chance.uniform(0, 15)


FAULTS: dict[str, Fault] = {
    "full disk": _full_disk, "read-only store": _read_only, "lost server": _lost_server,
    "sweeps at once": _sweeps_at_once, "file size limit": size_limit,
}  # fmt: skip
_MOUNTING = ("full disk", "read-only store")

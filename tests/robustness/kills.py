"""Signals to the processes of small studies, each of which must end as if it had not been disturbed."""

import os
import random
import shutil
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from headway.store.index import RunIndex
from headway.store.tracking.sync import sync_each
from tests.robustness.outcomes import FAILURES, Outcome, Scale, Tally
from tests.robustness.sessions import BOUND_S, TINY, Session, session_outcome
from tests.trials.processes import children_of, words_of
from tests.trials.same_study import differences, results_of

STUDY = "disturbed"
BASE = (
    f"study={STUDY}", *TINY, "rollout.copies=4", "rollout.block=2", "rollout.steps=10", "backend.parallel=1",
    "store.checkpoint_every=10", "backend.worker_timeout_s=2", "store.root=runs",
)  # fmt: skip
STUDIES: dict[str, tuple[str, ...]] = {
    "bus": ("env=bus", "algo=mappo", "seed=0,1", "env_steps=2000", "backend.workers=2"),
    "workers": ("env=visitors", "algo=ippo", "seed=0,1", "env_steps=4000", "backend.workers=2"),
    "stack": ("env=tracking", "algo=maa2c", "seed=0..2", "env_steps=4000", "backend.stack=3"),
    "asynchronous": ("env=visitors", "algo=a3c", "algo.application=in_turns", "seed=0,1", "env_steps=4000"),
}
_ROUND = 8
"""Signals in one study."""
_ATTEMPTS = 5
_STOP_S = 120.0
"""Time in which a session that was asked to stop must end, whatever its training processes do."""
_POLL_S = 0.1


@dataclass(frozen=True)
class Disturbance:
    """A signal to a process of a session."""

    target: str
    number: signal.Signals
    continues: bool = False
    """SIGCONT follows SIGSTOP."""

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"{self.number.name}{' and SIGCONT' if self.continues else ''} to {self.target}"


TARGETS = ("session", "training process", "rollout worker", "fork server")
DISTURBANCES = (
    *(
        Disturbance(target, number)
        for target in (*TARGETS, "process group")
        for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
        # Ctrl-C does not reach the fork server: its process group is that of the training process.
        if (target, number) != ("fork server", signal.SIGINT)
    ),
    *(Disturbance(target, signal.SIGSTOP, continues) for target in TARGETS for continues in (False, True)),
)


@dataclass
class DisturbedStudy:
    """A study in its store, and what has happened to it."""

    sweep: Sequence[str]
    folder: Path
    chance: random.Random
    outcomes: list[Outcome] = field(default_factory=list)
    """One per signal that reached a process."""
    history: list[str] = field(default_factory=list)
    table: str = ""
    """Output of the session that finished the study."""

    @property
    def root(self) -> Path:
        """The store."""
        return self.folder / "runs"

    def disturb(self, number: int) -> None:
        """Run sessions until `number` signals have reached their processes or the study has finished."""
        for session in range(3 * number):
            if self.table or len(self.outcomes) >= number:
                break
            if begun := self.root.exists() and bool(RunIndex(self.root).rows()):
                sync_each(self.root)  # MLflow has a part of each curve when the next session goes on
            words = ["resume", "--study", STUDY] if session % 2 and begun else ["sweep", *self.sweep]
            self.session(words, self.chance.choices(DISTURBANCES, k=number - len(self.outcomes)))

    def finish(self) -> None:
        """Run the sweep until it has finished."""
        for _ in range(_ATTEMPTS):
            if not self.table:
                self.session(["sweep", *self.sweep], [])

    def session(self, words: Sequence[str], disturbances: Sequence[Disturbance]) -> None:
        """Run a session and disturb it until it ends or has had all disturbances."""
        with Session(words, self.folder) as session:
            first, sent = len(self.outcomes), list[signal.Signals]()
            for disturbance in disturbances:
                sent += self._disturb_once(session, disturbance)
            code = session.end(_STOP_S if sent else BOUND_S)
            outcome = session_outcome(code, session.err, sent)
            self.history.append(f"{words[0]} ended with code {code}")
            if outcome in FAILURES:
                self.history.append(" | ".join(session.err.splitlines()[-8:]))
            if self.outcomes[first:]:
                self.outcomes[-1] = outcome
            elif outcome in FAILURES:
                self.outcomes.append(outcome)
            self.table = session.out if code == 0 else ""

    def _disturb_once(self, session: Session, disturbance: Disturbance) -> list[signal.Signals]:
        """Strike as soon as there is a target; return the signals that should end the session."""
        process = self._target(session, disturbance.target)
        if process is None or not _send(process, disturbance):
            return []
        self.history.append(disturbance.label)
        self.outcomes.append(Outcome.ACCEPTED)
        if disturbance.number != signal.SIGSTOP:
            return [disturbance.number] if disturbance.target in ("session", "process group") else []
        if disturbance.target == "rollout worker" and not disturbance.continues:
            return []  # it is replaced
        time.sleep(self.chance.uniform(0.1, 4.0))
        if disturbance.continues:
            _send(process, Disturbance(disturbance.target, signal.SIGCONT))
            return []
        ending = signal.SIGKILL if disturbance.target == "session" else signal.SIGTERM
        session.send(ending)
        return [ending]

    def _target(self, session: Session, target: str) -> psutil.Process | None:
        """Return a random process to disturb after a random time, None if the session ends before."""
        deadline = time.monotonic() + BOUND_S
        while session.is_running and time.monotonic() < deadline:
            if processes_of(session.process.pid, target):
                time.sleep(self.chance.uniform(0.0, 8.0 if target in ("session", "process group") else 2.0))
                processes = processes_of(session.process.pid, target) if session.is_running else []
                return self.chance.choice(processes) if processes else None
            time.sleep(_POLL_S)
        return None


def campaign(scale: Scale, seed: int, folder: Path) -> list[Tally]:
    """Strike studies in turn until the number of signals of a scale has been sent."""
    tallies = {name: Tally(f"kills: {name}") for name in STUDIES}
    tables: dict[str, str] = {}
    done = number = 0
    while done < scale.kills:
        name = list(STUDIES)[number % len(STUDIES)]
        sweep, whole = [*STUDIES[name], *BASE], folder / f"{name}-whole"
        if name not in tables:
            tables[name] = undisturbed(sweep, whole)
        disturbed = DisturbedStudy(sweep, folder / f"{name}-{number}", random.Random(f"{seed} {number}"))
        disturbed.disturb(min(_ROUND, scale.kills - done))
        done += len(disturbed.outcomes)
        disturbed.finish()
        found = compared(disturbed.table, disturbed.root, tables[name], whole / "runs")
        repeat = f"round {number} of seed {seed}: {'; '.join(disturbed.history)}"
        for outcome in disturbed.outcomes:
            tallies[name].add(outcome, repeat)
        if found:
            tallies[name].add(Outcome.LOST, f"{repeat}: {found}")
        shutil.rmtree(disturbed.folder)
        number += 1
    return list(tallies.values())


def undisturbed(sweep: Sequence[str], folder: Path) -> str:
    """Run a sweep in one session; return its table."""
    with Session(["sweep", *sweep], folder) as session:
        if code := session.end():
            raise SystemExit(f"the undisturbed study ended with code {code}: {session.err}")
        return session.out


def compared(table: str, root: Path, whole_table: str, whole: Path) -> list[str]:
    """Return the differences of a disturbed study from the undisturbed one."""
    if not table:
        return ["it does not finish"]
    for store in (root, whole):
        sync_each(store)
    tables = [] if results_of(table) == results_of(whole_table) else ["the tables differ"]
    return [*tables, *differences(whole, root)]


def processes_of(session: int, target: str) -> list[psutil.Process]:
    """Return the live processes of a kind, see `DISTURBANCES`, of the session with this process id."""
    try:
        process = psutil.Process(session)
    except psutil.NoSuchProcess:
        return []
    if target in ("session", "process group"):
        return [process]
    trainers = [child for child in children_of(process) if "spawn_main" in words_of(child)]
    if target == "training process":
        return trainers
    below = [child for trainer in trainers for child in children_of(trainer)]
    servers = [child for child in below if "forkserver" in words_of(child)]
    return servers if target == "fork server" else [each for one in servers for each in children_of(one)]


def _send(process: psutil.Process, disturbance: Disturbance) -> bool:
    """Send the signal; return whether the process existed."""
    try:
        if disturbance.target == "process group":
            os.killpg(process.pid, disturbance.number)
        else:
            process.send_signal(disturbance.number)
    except (psutil.NoSuchProcess, ProcessLookupError):
        return False
    return True

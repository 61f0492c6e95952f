"""Environments that lie, raise, hang, fork, leak and exit, in `headway run` with a tiny budget."""

import os
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from headway.store.index import RunIndex
from headway.store.parquet_log import read_rows
from tests.robustness.misbehaving import ACTS, ANSWERS, FATAL, HANGING, HARMLESS, PRINTED, STEP_ANSWERS
from tests.robustness.outcomes import FAILURES, Outcome, Scale, Tally
from tests.robustness.sessions import BOUND_S, TINY, Session, error_lines, session_outcome

_PATIENCE_S = 60.0
"""Time after which a user interrupts a session that an environment may hold up."""
_SECOND_INTERRUPT_S = 3.0
_MODULE = "misbehaving_zoo.street"
_RUN = (
    f"env={_MODULE}", "algo=ippo", "seed=0", *TINY, "rollout.copies=2", "rollout.block=1", "rollout.steps=8",
    "env_steps=64", "store.root=runs", "backend.workers=2", "backend.worker_timeout_s=3",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A fault of the environment, its moment and the backend."""

    fault: str
    place: str
    at: int
    once: bool
    spares_session: bool
    backend: str

    @classmethod
    def drawn(cls, chance: random.Random) -> "Case":
        """Return a random case."""
        fault = chance.choice([*ACTS, *ANSWERS])
        places = {"constructor": 1, "reset": 2, "close": 1, "step": 6}
        if fault in ANSWERS:
            places = {"step": 1} if fault in STEP_ANSWERS else {"reset": 1, "step": 3}
        [place] = chance.choices(list(places), list(places.values()))
        at = chance.randint(1, {"step": 40, "reset": 6}.get(place, 1))
        spares_session = fault in FATAL or chance.random() < 0.7
        return cls(
            fault, place, at, chance.random() < 0.5, spares_session, chance.choice(["serial", "process"])
        )

    def arguments(self, folder: Path) -> dict[str, Any]:
        """Return the environment's arguments."""
        mark = str(folder / "mark") if self.once else ""
        return {"fault": self.fault, "place": self.place, "at": self.at, "mark": mark,
                "spares_session": self.spares_session}  # fmt: skip


def campaign(scale: Scale, seed: int, folder: Path) -> list[Tally]:
    """Run the cases of a scale."""
    tally, chance = Tally("environments"), random.Random(seed)
    install_module(folder)
    undisturbed = _curve_of(run_case(None, folder, folder / "undisturbed")[2])
    for number in range(scale.environments):
        case = Case.drawn(chance)
        outcome, why, root = run_case(case, folder, folder / f"{number}")
        if outcome is Outcome.ACCEPTED and case.fault in HARMLESS and _curve_of(root) != undisturbed:
            outcome, why = Outcome.LOST, "its curve differs from that of an undisturbed run"
        tally.add(outcome, f"{case}: {why}" if outcome in FAILURES else "")
    return [tally]


def install_module(folder: Path) -> None:
    """Write the environment's module as an installed package, as `env=PACKAGE.MODULE` requires."""
    package, installed = folder / "misbehaving_zoo", folder / "misbehaving_zoo-1.0.dist-info"
    metadata = "Metadata-Version: 2.1\nName: misbehaving_zoo\nVersion: 1.0\nRequires-Dist: pettingzoo\n"
    for path, text in (
        (package / "__init__.py", ""),
        (package / "street.py", "from tests.robustness.misbehaving import parallel_env\n"),
        (installed / "METADATA", metadata),
        (installed / "RECORD", "misbehaving_zoo/__init__.py,,\n"),
    ):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)


def run_case(case: Case | None, installed: Path, folder: Path) -> tuple[Outcome, str, Path]:
    """Run a case, None: without a fault; return its outcome, the last it wrote to stderr and its store."""
    words = ["run", *_RUN]
    if case is not None:
        words += [f"backend={case.backend}"]
        words += [f"env.args.{name}={_quoted(value)}" for name, value in case.arguments(folder).items()]
    path = os.pathsep.join([str(installed), os.environ.get("PYTHONPATH", "")])
    with Session(words, folder, {"PYTHONPATH": path}) as session:
        interrupts = _wait(session, interrupt=case is not None and case.fault in HANGING)
        code = session.end(BOUND_S)
        outcome = session_outcome(code, session.err, interrupts)
        why = f"code {code}: {' | '.join(session.err.splitlines()[-4:])[:600]}"
        if outcome is Outcome.CLEAR and len(error_lines(session.err)) > 1:
            outcome = Outcome.UNEXPECTED
        if PRINTED in session.out:
            outcome, why = Outcome.UNEXPECTED, "what it printed is among the results"
        if outcome is Outcome.ACCEPTED and code == 0 and "FINISHED" not in session.out:
            outcome = Outcome.LOST
    return outcome, why, folder / "runs"


def _wait(session: Session, interrupt: bool) -> list[signal.Signals]:
    """Wait for the end of a session, or press Ctrl-C as a user would; return the signals sent."""
    deadline, sent = time.monotonic() + _PATIENCE_S, list[signal.Signals]()
    while interrupt and session.is_running and len(sent) < 2:
        time.sleep(0.2)
        if time.monotonic() > deadline:
            session.send(signal.SIGINT)
            sent.append(signal.SIGINT)
            deadline += _SECOND_INTERRUPT_S
    return sent


def _quoted(value: object) -> str:
    return f"'{value}'" if isinstance(value, str) else str(value).lower()


def _curve_of(root: Path) -> list[dict[str, Any]]:
    [run] = RunIndex(root).rows()
    rows = read_rows(Path(run.directory), "curve")
    return [{name: row[name] for name in row if not name.startswith(("time/", "wall_s"))} for row in rows]

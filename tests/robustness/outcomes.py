"""Outcomes of faults: how a command line ended, and the counts of a campaign."""

import re
import sys
from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from unicodedata import category


class Outcome(StrEnum):
    """End of one case; the last three are failures."""

    CLEAR = "clear"
    """Exit code 1 or 2 and one line that says what is wrong."""
    ACCEPTED = "accepted"
    """Exit code 0."""
    UNEXPECTED = "unexpected"
    """A traceback, an "unexpected" error, several lines of error, or death by a signal."""
    LOST = "lost"
    """Data that was fine before is gone or no longer listed."""
    HUNG = "hung"
    """No end within the bound."""


FAILURES = (Outcome.UNEXPECTED, Outcome.LOST, Outcome.HUNG)


@dataclass(frozen=True)
class Scale:
    """Number of cases per area."""

    overrides: int
    files: int
    kills: int
    environments: int
    storage: int


MINUTES = Scale(overrides=500, files=120, kills=6, environments=20, storage=10)
"""About ten minutes on two cores."""
HOURS = Scale(overrides=5_000, files=1_000, kills=100, environments=200, storage=100)
SCALES = {"minutes": MINUTES, "hours": HOURS}


@dataclass
class Tally:
    """Outcomes of one area."""

    area: str
    counts: Counter[Outcome] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    """One line per failure that repeats it."""

    def add(self, outcome: Outcome, how_to_repeat: str) -> None:
        """Count a case, and print it if it failed; an empty `how_to_repeat` marks a failure already shown."""
        self.counts[outcome] += 1
        if outcome in FAILURES and how_to_repeat:
            self.failures.append(how_to_repeat)
            print(f"{self.area}: {outcome}: {how_to_repeat}", flush=True)
        if self.counts.total() % 100 == 0:
            counts = ", ".join(f"{count} {name}" for name, count in self.counts.items())
            print(f"{self.area}: {self.counts.total()} tried: {counts}", file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Ended:
    """How a command line ended."""

    code: int | None
    """Exit code; negative: the signal that ended it; None: it was stopped after its time."""
    errors: str
    """Text on stderr."""


_NUMBER, _QUOTED = re.compile(r"\d+"), re.compile(r"'[^']*'|\"[^\"]*\"|[/\w.-]*/[/\w.-]*")
_FOREIGN = re.compile(r"Traceback|unexpected|\w+Warning: ")
"""Patterns that no line of Headway's output may contain."""


def outcome_of(ended: Ended) -> Outcome:
    """Classify the end of a command line. Lines before the last are notices and progress."""
    if ended.code is None:
        return Outcome.HUNG
    if ended.code == 0 and "Traceback" not in ended.errors:
        return Outcome.ACCEPTED
    lines = ended.errors.removesuffix("\n").split("\n")
    told = lines[-1].startswith("headway:") and not _FOREIGN.search(ended.errors)
    raw = any(category(char) in ("Cc", "Cf", "Cs") for line in lines for char in line.replace("\t", ""))
    return Outcome.CLEAR if ended.code in (1, 2) and told and not raw else Outcome.UNEXPECTED


def signature_of(ended: Ended) -> str:
    """Return a text that is equal for failures with the same cause: the last line without its particulars."""
    last = ended.errors.strip().rpartition("\n")[2]
    return f"{ended.code} {_NUMBER.sub('0', _QUOTED.sub('...', last))[:80]}"

"""Robustness campaign: faults of many kinds, each of which must end in success or one clear line.

    python -m tests.robustness --scale minutes|hours --only AREA ... --seed N

Prints each failure with the line that repeats it, then a table; exits with code 1 if anything failed.
"""

import argparse
import secrets
import sys
import tempfile
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from headway_launch.console.tables import Value, print_table
from tests.robustness.outcomes import FAILURES, SCALES, Outcome, Tally

AREAS = ("overrides", "files", "kills", "environments", "storage")
"""Modules, each of which offers `campaign(scale, seed, folder) -> list[Tally]`."""


def main() -> None:
    """Run the campaign; see the module."""
    parser = argparse.ArgumentParser(description="Give Headway faults of many kinds and count how they end.")
    parser.add_argument("--scale", choices=SCALES, default="minutes", help="number of cases")
    parser.add_argument("--only", choices=AREAS, nargs="+", default=AREAS, metavar="AREA")
    parser.add_argument("--seed", type=int, help="repeats the campaign that printed it")
    arguments = parser.parse_args()
    seed = secrets.randbits(32) if arguments.seed is None else arguments.seed
    print(f"python -m tests.robustness --scale {arguments.scale} --seed {seed}", flush=True)
    tallies: list[Tally] = []
    for area in arguments.only:
        campaign = import_module(f"tests.robustness.{area}").campaign
        with tempfile.TemporaryDirectory(prefix="headway-robustness-") as folder:
            tallies += campaign(SCALES[arguments.scale], seed, Path(folder))
    sys.exit(report(tallies))


def report(tallies: Sequence[Tally]) -> int:
    """Print the table; return the exit code."""
    rows: list[tuple[Value, ...]] = [
        (tally.area, tally.counts.total(), *(tally.counts[outcome] for outcome in Outcome))
        for tally in tallies
    ]
    print_table(("area", "tried", *map(str, Outcome)), rows)
    return int(any(tally.counts[outcome] for tally in tallies for outcome in FAILURES))


if __name__ == "__main__":
    main()

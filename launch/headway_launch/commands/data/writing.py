"""The folder that a scenario is written to, and what is said of it."""

import argparse
import shutil
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from headway_envs.bus.scenario.tables import Tables


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """OUT and --replace."""
    parser.add_argument("out", metavar="OUT", help="folder to write the scenario to")
    parser.add_argument("--replace", action="store_true", help="write over the scenario that OUT holds")


def check_output(arguments: argparse.Namespace) -> Path:
    """The folder to write; before any work, so that none is lost. Raises HeadwayError if it is taken."""
    out = Path(arguments.out)
    if out.exists() and not out.is_dir():
        raise HeadwayError(f"OUT: {out} is a file; name a folder")
    if out.is_dir() and any(out.iterdir()):
        if not (out / "meta.json").is_file():
            raise HeadwayError(f"OUT: {out} holds other files; name a new folder")
        if not arguments.replace:
            raise HeadwayError(f"OUT: {out} holds a scenario; --replace writes over it")
    return out


def write_scenario(tables: "Tables", out: Path) -> None:
    """Check and write; a scenario that was there is replaced when the new one is whole."""
    from headway_envs.bus.scenario.tables import check_tables, write_tables

    check_tables(tables)
    unfinished = out.with_name(f"{out.name}.unfinished")
    try:
        with suppress(FileNotFoundError):
            shutil.rmtree(unfinished)
        write_tables(tables, unfinished)
        if out.is_dir():
            shutil.rmtree(out)
        unfinished.rename(out)
    except OSError as error:
        with suppress(OSError):
            shutil.rmtree(unfinished)
        raise HeadwayError(f"OUT: {out} cannot be written ({error})") from error


def tell_written(tables: "Tables", out: Path) -> None:
    """What was written, in a line each, and what to do with it."""
    from headway_envs.bus.scenario.describing import by_day_type

    print(
        f"{out}: {tables.patterns['line'].nunique():,} lines, {len(tables.patterns):,} patterns, "
        f"{len(tables.stops):,} stops, {len(tables.links):,} links"
    )
    for day in by_day_type(tables):
        print(
            f"{day.day_type}: {day.trips:,} trips, {day.peak_buses:,} buses at once, "
            f"{day.boardings:,.0f} boardings"
        )
    for name, count in tables.meta.get("counted", {}).items():
        if count:
            print(f"{name}: {count:,}")
    print(f"next: headway data describe {out}; headway run env=bus env.args.scenario={out} algo=mappo")

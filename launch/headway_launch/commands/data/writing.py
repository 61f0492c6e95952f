"""Writing a scenario folder, and the summary printed afterwards."""

import argparse
import math
import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway.wording import counted
from headway_launch.console.output_files import write_error
from headway_launch.console.progress_display import CountedProgress

if TYPE_CHECKING:
    from headway_envs.bus.scenario.description import DayStatistics
    from headway_envs.bus.scenario.tables import Tables

_SETTINGS = (
    (50, "env=bus algo=mappo"),
    (400, "experiment=bus_network study=mine seed=0"),
    (math.inf, "experiment=bus_city study=mine seed=0"),
)
"""Maximum number of buses at once, and what is suggested to train up to it."""


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add OUT and --replace."""
    parser.add_argument("out", metavar="OUT", help="folder to write the scenario to")
    parser.add_argument("--replace", action="store_true", help="overwrite the scenario in OUT")


def check_output(arguments: argparse.Namespace) -> Path:
    """Return the folder to write; called before any work. Raises HeadwayError if the folder is in use."""
    from headway_envs.bus.config import SCENARIOS

    out = Path(arguments.out)
    if str(out) in SCENARIOS:
        raise HeadwayError(
            f"env.args.scenario={out} selects the built-in scenario; choose another name, such as my_{out}"
        )
    here = Path.cwd()
    if out.resolve() in (here, *here.parents):
        raise HeadwayError(f"{out} is the working directory or one of its parents; name a folder in it")
    if out.exists() and not out.is_dir():
        raise HeadwayError(f"{out} is a file; name a folder")
    _refuse_others(out)
    if out.is_dir() and any(out.iterdir()) and not arguments.replace:
        raise HeadwayError(f"{out} holds a scenario; --replace overwrites it")
    return out


def _refuse_others(out: Path) -> None:
    """Raise HeadwayError if the folder exists and contains anything other than a scenario."""
    from headway_envs.bus.scenario.tables import COLUMNS

    held = {entry.name: entry.is_file() for entry in out.iterdir()} if out.is_dir() else {}
    tables = {f"{name}.parquet" for name in COLUMNS}
    others = [name for name, is_file in held.items() if not is_file or name not in {*tables, "meta.json"}]
    if held and not others and not tables & set(held):
        others = ["meta.json"]  # without tables, it may not be a scenario's
    if others:
        raise HeadwayError(f"{out} holds other files ({min(others)}); name a new folder")


def write_scenario(tables: "Tables", out: Path) -> None:
    """Check and write a scenario, and print a summary.

    An old scenario in its place is removed once the new one is complete.
    """
    from headway_envs.bus.scenario.tables import check_tables, write_tables

    check_tables(tables)
    folder = out.resolve()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            prefix=f".{folder.name}.", dir=folder.parent, ignore_cleanup_errors=True
        ) as beside:
            new, old = Path(beside) / "new", Path(beside) / "old"
            write_tables(tables, new)
            _refuse_others(folder)
            try:
                if folder.is_dir():
                    folder.rename(old)
                new.rename(folder)
            finally:
                if old.is_dir() and not folder.exists():
                    old.rename(folder)
    except OSError as error:
        raise write_error("OUT", folder, error) from error
    _print_written(tables, out)


def _print_written(tables: "Tables", out: Path) -> None:
    """Print a summary of the scenario and the next commands."""
    from headway_envs.bus.scenario.description import by_day_type
    from headway_envs.bus.scenario.tables import DAY_TYPES

    print(
        f"{out}: {counted(tables.patterns['line'].nunique(), 'line')}, "
        f"{counted(len(tables.patterns), 'pattern')}, {counted(len(tables.stops), 'stop')}, "
        f"{counted(len(tables.links), 'link')}"
    )
    with CountedProgress("day types described", len(DAY_TYPES)) as progress:
        days = by_day_type(tables, progress.add)
    for day in days:
        print(
            f"{day.day_type}: {day.trips:,} trips, {day.peak_buses:,} buses at once, "
            f"{day.boardings:,.0f} boardings"
        )
    for name, count in tables.meta.get("counted", {}).items():
        if count:
            print(f"{name}: {count:,}")
    buses = max(day.peak_buses for day in days)
    settings = next(settings for most, settings in _SETTINGS if buses <= most)
    # An environment runs weekdays by default.
    day_type = "" if days[0].day_type == "weekday" else f"env.args.day_type={days[0].day_type} "
    scenario = shlex.quote(f"env.args.scenario={out}")
    given = f"{settings} {scenario} {day_type}{_service_hours(days[0])}".rstrip()
    print(f"next: headway data describe {shlex.quote(str(out))}; headway run {given}")


def _service_hours(day: "DayStatistics") -> str:
    """Return the settings of the simulated hours, and print why, if the service is shorter than by default.

    Passengers who remain after the last bus are charged until the end of the simulated day.
    """
    from headway_envs.bus.config import BusConfig, service_hours
    from headway_envs.bus.scenario.description import clock

    config = BusConfig()
    if math.floor(day.first_h) <= config.start_hour and math.ceil(day.last_h) >= config.end_hour:
        return ""
    start, end = service_hours(day.first_h, day.last_h)
    print(
        f"service: {clock(day.first_h)} to {clock(day.last_h)}, whereas {clock(config.start_hour)} to "
        f"{clock(config.end_hour)} is simulated by default: keep start_hour and end_hour below in every "
        "command"
    )
    return f"env.args.start_hour={start} env.args.end_hour={end} "

"""Options that several data commands share: scenarios, seeds, day types, dates and lists of names."""

import argparse
import datetime as dt
from typing import TYPE_CHECKING, Any, Literal

from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from headway_envs.bus.scenario.tables import Tables


def require_seed(seed: int) -> None:
    """Raise HeadwayError if the value of `--seed` is negative."""
    if seed < 0:
        raise HeadwayError(f"--seed must be at least 0, not {seed}")


def day_type_of(
    tables: "Tables", wanted: Literal["weekday", "sunday"] | None
) -> Literal["weekday", "sunday"]:
    """Return the value of `--day-type`; default: weekday if it has trips, else Sunday."""
    there = set(tables.trips["daytype"])
    return wanted or ("weekday" if "weekday" in there else "sunday")


def add_scenario_arguments(parser: argparse.ArgumentParser, day_type: str) -> None:
    """Add SCENARIO, --seed and --day-type, whose help is `day_type`."""
    parser.add_argument("scenario", metavar="SCENARIO", help="folder, or line, corridor, district or city")
    parser.add_argument("--day-type", choices=("weekday", "sunday"), help=day_type)
    parser.add_argument("--seed", type=int, default=0, help="seed of a built-in scenario (default: 0)")


def add_selection_arguments(parser: argparse.ArgumentParser, drawn: str) -> None:
    """Add the days and lines to import, and --seed, by which `drawn` is drawn."""
    for option, day in (("--weekday", "weekday"), ("--sunday", "Sunday")):
        said = f"YYYY-MM-DD, of the timetable (default: the {day} with the most trips)"
        parser.add_argument(option, metavar="DATE", help=said)
    parser.add_argument("--lines", help="names of lines, comma-separated (default: all)")
    parser.add_argument("--seed", type=int, default=0, help=f"seed of {drawn} (default: 0)")


def selection_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return `weekday`, `sunday`, `lines` and `seed` of an import. Raises HeadwayError if one is wrong."""
    require_seed(arguments.seed)
    days = {day: _date_of(day, getattr(arguments, day)) for day in ("weekday", "sunday")}
    return {**days, "lines": names_of(arguments.lines), "seed": arguments.seed}


def _date_of(day: str, text: str | None) -> dt.date | None:
    if text is None:
        return None
    try:
        return dt.date.fromisoformat(text)
    except ValueError as error:
        raise HeadwayError(f"--{day}: '{text}' is not a date YYYY-MM-DD") from error


def names_of(text: str | None) -> tuple[str, ...]:
    """Return comma-separated names."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())

"""`headway search`: a small search for hyper-parameters, itself a committed configuration."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import mean
from typing import TYPE_CHECKING, Any

from headway.configuration import build, suggestion
from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from headway.config import ExperimentConfig
    from headway_launch.composing import Experiment

EXAMPLES = """\
examples:
  headway search bus_line
  headway search bus_line env_steps=100_000 study=bus_line_quick

A search is a file of configs/search: an experiment, cells (what each gets its own winner for) and
candidates (overrides tried in every cell). Every cell has the same candidates, seeds and budget; the
winner has the highest mean final reward. All train side by side; the same search given again goes on
where it stopped. Give it seeds that no study reports: on the seeds it was chosen by, a winner looks better
than it is. `headway list searches` names them.
"""


@dataclass(frozen=True)
class Search:
    """The contents of a file in configs/search."""

    base: tuple[str, ...]
    """Overrides of every run, `experiment=...` and `seed=...` among them."""
    cells: Mapping[str, Any]
    """Name -> list of overrides."""
    candidates: Mapping[str, Any]
    """Name -> list of overrides."""
    name: str = ""
    """Of its file."""

    def points(self, overrides: Sequence[str] = ()) -> dict[tuple[str, str], "Experiment"]:
        """Every candidate in every cell, by both names.

        Raises HeadwayError for what cannot be used, and where two would train the same.
        """
        from headway_launch.composing import compose
        from headway_launch.planning import full_mapping
        from headway_launch.stored import identity
        from headway_launch.sweeping import require_one_session

        points = {
            (cell, candidate): compose([*self.base, *in_cell, *tried, *overrides])
            for cell, in_cell in self.cells.items()
            for candidate, tried in self.candidates.items()
        }
        require_one_session(list(points.values()))
        known: dict[str, tuple[str, str]] = {}
        for place, experiment in points.items():
            other = known.setdefault(identity(full_mapping(experiment, ())), place)
            if other != place:
                raise HeadwayError(
                    f"search {self.name}: {': '.join(other)} and {': '.join(place)} are the same experiment; "
                    "give each its own values, and override none of them"
                )
        return points


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The search and overrides of its base."""
    parser.add_argument("search", metavar="SEARCH", help="a file of configs/search, without .yaml")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="overrides of every run")
    parser.add_argument("--fresh", action="store_true", help="train anew what the store has, too")


def execute(arguments: argparse.Namespace) -> int:
    """Run every candidate in every cell and print which won; returns the exit code."""
    from headway_launch.threads import limit_threads

    limit_threads()
    from headway_launch.conducting import EXIT_DONE
    from headway_launch.studying import StudySession
    from headway_launch.tables import print_table
    from headway_launch.telling import to_a_reader

    search = read_search(arguments.search)
    points = search.points(arguments.overrides)
    labels = [": ".join(place) for place in points]
    conductor = StudySession.plan(list(points.values()), labels, arguments.fresh).conductor(arguments.debug)
    code = conductor.conduct()
    if code != EXIT_DONE:
        return code
    results = {place: mean(rewards) for place, rewards in zip(points, conductor.final_rewards(), strict=True)}
    winners = {
        cell: max(search.candidates, key=lambda candidate: results[cell, candidate]) for cell in search.cells
    }
    rows = [
        (cell, candidate, results[cell, candidate], "best" if winners[cell] == candidate else "")
        for cell, candidate in points
    ]
    config = next(iter(points.values())).config
    with to_a_reader(sys.stdout):
        print_table(("cell", "candidate", "mean final reward", ""), rows, title=_title(config))
    return EXIT_DONE


def _title(config: "ExperimentConfig") -> str:
    seeds = ", ".join(str(seed) for seed in config.seed)
    return f"search on {config.env.id}: seeds {seeds}, {config.env_steps:,} environment steps each"


def read_search(name: str) -> Search:
    """A search of configs/search.

    Raises HeadwayError where there is none of that name, or it cannot be read.
    """
    import yaml

    from headway_launch.composing import configs_folder

    folder = configs_folder() / "search"
    known: Sequence[str] = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in known:
        raise HeadwayError(f"there is no search {name!r}; {suggestion(name, known)}")
    try:
        content = yaml.safe_load((folder / f"{name}.yaml").read_text())
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise HeadwayError(f"configs/search/{name}.yaml is not valid YAML: {problem}") from error
    return replace(build(Search, content, f"search/{name}"), name=name)

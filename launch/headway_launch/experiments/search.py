"""Hyper-parameter searches: the files of configs/search and the experiments that they describe."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import yaml

from headway.config.schema import build, suggestion
from headway.contracts.checks import require_key
from headway.contracts.errors import HeadwayError
from headway_launch.experiments.compose import Experiment, compose
from headway_launch.experiments.options import config_file, options
from headway_launch.experiments.parameters import full_mapping, identity
from headway_launch.experiments.sweep import require_one_session

Point = tuple[str, str]
"""Names of a cell and of a candidate."""


@dataclass(frozen=True)
class Search:
    """A hyper-parameter search: the contents of a file in configs/search."""

    base: tuple[str, ...]
    """Overrides of every run, including `experiment=...` and `seed=...`."""
    cells: Mapping[str, tuple[str, ...]]
    """Cell name -> its overrides."""
    candidates: Mapping[str, tuple[str, ...]]
    """Candidate name -> its overrides."""

    def __post_init__(self) -> None:
        for name, values in (("cells", self.cells), ("candidates", self.candidates)):
            forms = "must have one entry or more, each a name with a list of overrides"
            require_key(bool(values), name, forms)

    def points(self, overrides: Sequence[str] = ()) -> dict[Point, Experiment]:
        """Return the experiment of every candidate in every cell; `overrides` apply to all.

        Raises HeadwayError for an invalid override, and if two experiments are equal.
        """
        points = {
            (cell, candidate): _with_candidate(candidate, compose([*self.base, *in_cell, *tried, *overrides]))
            for cell, in_cell in self.cells.items()
            for candidate, tried in self.candidates.items()
        }
        require_one_session(list(points.values()))
        known: dict[str, Point] = {}
        for point, experiment in points.items():
            other = known.setdefault(identity(full_mapping(experiment, ())), point)
            if other != point:
                raise HeadwayError(
                    f"{': '.join(other)} and {': '.join(point)} are the same experiment; give each candidate "
                    "its own values and do not override them"
                )
        return points


def _with_candidate(candidate: str, experiment: Experiment) -> Experiment:
    return replace(experiment, config=replace(experiment.config, candidate=candidate))


def read_search(name: str) -> Search:
    """Read a search of the group `search`. Raises HeadwayError if it does not exist or is not valid."""
    known = options()["search"]
    if name not in known:
        raise HeadwayError(f"there is no search {name!r}; {suggestion(name, known)}")
    path = config_file("search", name)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError) as error:
        raise HeadwayError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, Mapping):
        raise HeadwayError(f"{path} must have the keys base, cells and candidates")
    return build(Search, content, f"search/{name}")

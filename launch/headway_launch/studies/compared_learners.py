"""Learners to compare, of one or several studies, and the environment that they have in common."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations
from pathlib import Path

from headway.contracts.errors import HeadwayError
from headway.store.cell_names import labelled_cells
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.parameters import flat
from headway_launch.runner.stored_run import StoredRun
from headway_launch.studies.runs import finished_runs

_MAX_DIFFERENCES = 3
"""Maximum number of differences between environments that an error lists."""


@dataclass(frozen=True)
class ComparedLearners:
    """Learners to compare, and their environment."""

    name: str
    """The studies and what is changed, or the environment if only rules are compared."""
    experiment: Experiment
    studies: Sequence[Mapping[str, list[StoredRun]]] = ()
    """Per study, the runs of each learner by label; empty if only rules are compared."""
    changed: Sequence[str] = ()
    """Overrides of the studies' environment, `env.args.KEY=VALUE`."""
    changes: Sequence[str] = ()
    """What each of `changed` changes, in words."""

    @classmethod
    def of(cls, studies: Mapping[str, tuple[Path, str]], where: Sequence[str]) -> "ComparedLearners":
        """Return the finished runs for which `where` holds of `studies`, which maps names to store and study.

        Raises HeadwayError if a study has none.
        """
        found = [_cells(root, study, where) for root, study in studies.values()]
        if len(found) > 1:
            found = [
                {f"{name}: {label}": members for label, members in cells.items()}
                for name, cells in zip(studies, found, strict=True)
            ]
        return cls(" and ".join(studies), next(iter(found[0].values()))[0].experiment, found)

    def with_env_args(self, changed: Sequence[str]) -> "ComparedLearners":
        """Return the learners on their environment with other arguments, `env.args.KEY=VALUE`.

        Raises HeadwayError for other keys.
        """
        if not changed:
            return self
        experiment, changes = next(iter(self.cells.values()))[0].with_env_args(changed)
        name = " ".join((self.name, *changed))
        return replace(self, name=name, experiment=experiment, changed=changed, changes=changes)

    @property
    def cells(self) -> Mapping[str, list[StoredRun]]:
        """Runs of each learner by label."""
        return {label: members for study in self.studies for label, members in study.items()}

    def pairs(self, suffix: str) -> list[tuple[str, str]]:
        """Return the labels, with a suffix, of the pairs to compare: of different studies, if several."""
        several = combinations(self.studies, 2)
        found = [(a, b) for one, other in several for a in one for b in other] or combinations(self.cells, 2)
        return [(f"{a}{suffix}", f"{b}{suffix}") for a, b in found]

    def require_one_environment(self) -> None:
        """Raise HeadwayError if the evaluation environments of the learners differ."""
        environments = [members[0].experiment.evaluated_env for members in self.cells.values()]
        if differing := _differing(environments):
            more = "; ..." if len(differing) > _MAX_DIFFERENCES else ""
            shown = "; ".join(
                f"{key} ({values})" for key, values in list(differing.items())[:_MAX_DIFFERENCES]
            )
            have = "study {} holds" if len(self.studies) == 1 else "studies {} hold"
            raise HeadwayError(
                f"{have.format(self.name)} several environments, which differ in {shown}{more}: choose one, "
                f"such as --where '{next(iter(differing))}=...'; `headway report` compares over environments"
            )


def _cells(root: Path, study: str, where: Sequence[str]) -> Mapping[str, list[StoredRun]]:
    """Return the finished runs of a study for which `where` holds, by label.

    Raises HeadwayError if there are none.
    """
    read = cache(partial(StoredRun.read, root))
    runs = finished_runs(root, study, where, read)
    return {
        label: [read(Path(row.directory)) for row in members]
        for label, members in labelled_cells(runs.rows, runs.beside).items()
    }


def _differing(environments: Sequence[Mapping[str, object]]) -> dict[str, str]:
    """Return the values of each key in which evaluation environments differ."""
    settings = [dict(flat({"env": environment})) for environment in environments]
    keys = dict.fromkeys(key for each in settings for key in each)
    values = {key: list(dict.fromkeys(str(each.get(key)) for each in settings)) for key in keys}
    return {key: ", ".join(found) for key, found in values.items() if len(found) > 1}

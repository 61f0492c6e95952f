"""A session on a study: what its store has already is left alone, what stopped goes on, the rest begins."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from platform import node

from headway.contracts.errors import HeadwayError
from headway.store import RunRecord
from headway.store.index import RunIndex
from headway_launch.console.output import print_line
from headway_launch.experiments.compose import Experiment
from headway_launch.runner.jobs import CellPlan
from headway_launch.runner.runner import Runner
from headway_launch.studies.plan import StudyProgress, keep_plan, plan_cells


@dataclass(frozen=True)
class StudySession:
    """What one session has to do for the experiments, all of one study and one store."""

    experiments: tuple[Experiment, ...]
    standings: tuple[StudyProgress, ...]
    cells: tuple[CellPlan, ...]

    @classmethod
    def plan(
        cls, experiments: Sequence[Experiment], labels: Sequence[str] | None = None, fresh: bool = False
    ) -> "StudySession":
        """`labels`: what the cells are called; None: by what they differ in. `fresh`: as if the store had
        nothing. Raises HeadwayError for what cannot run."""
        config = experiments[0].config
        root = Path(config.store.root)
        index = RunIndex(root)
        rows = index.rows(config.study)
        for notice in index.notices:
            print_line(f"headway: {notice}")
        standings = [
            StudyProgress.untouched(experiment) if fresh else StudyProgress.of(root, experiment, rows)
            for experiment in experiments
        ]
        return cls(tuple(experiments), tuple(standings), tuple(plan_cells(standings, labels)))

    def open_runner(self, debug: bool) -> Runner:
        """Ready to conduct; the plan is kept in the store. Raises HeadwayError where that cannot be used."""
        config = self.experiments[0].config
        runner = Runner(self.cells, debug, plan_kept=True)
        keep_plan(Path(config.store.root), config.study, self.experiments)
        tell_standing(config.study, self.standings)
        return runner

    def require_all_ended(self) -> None:
        """See `require_all_ended`."""
        require_all_ended(self.experiments[0].config.study, held_elsewhere(self.standings))


def tell_standing(study: str, standings: Sequence[StudyProgress]) -> None:
    """A line on what the store has already, nothing where that is nothing."""
    counts = {
        "have finished and are left alone": sum(len(standing.finished) for standing in standings),
        "go on": sum(len(standing.unfinished) for standing in standings),
        "are left to the session that trains them": sum(len(standing.elsewhere) for standing in standings),
        "begin": sum(len(standing.new) for standing in standings),
    }
    if any(counts[kind] for kind in list(counts)[:3]):
        parts = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
        print_line(f"headway: of {sum(counts.values())} runs of study {study}, {parts}")


def held_elsewhere(standings: Sequence[StudyProgress]) -> list[Path]:
    """The folders of runs that other sessions train."""
    return [run.directory for standing in standings for run in standing.elsewhere]


def require_all_ended(study: str, left: Sequence[Path]) -> None:
    """Raise HeadwayError, with what to do, where runs in these folders, which were left to other sessions,
    have not finished. Of a session on another host nobody can tell from here that it is gone."""
    from headway.stats.plots import counted

    records = [record for record in map(RunRecord.read, left) if record.settled_status != "FINISHED"]
    if not records:
        return
    held = {record.session for record in records if record.settled_status == "RUNNING"}
    who = [f"process {session.pid} on {session.host}" for session in sorted(held, key=str)]
    line = f"{counted(len(records), 'run')} of study {study} left to other sessions and not finished"
    line += f" (held by {', '.join(who)})" if who else ""
    line += ": give this command again when these have ended"
    if any(session.host != node() for session in held):
        line += '; where one was killed, on its host, or with "status": "KILLED" in the run.json of its runs'
    raise HeadwayError(line)

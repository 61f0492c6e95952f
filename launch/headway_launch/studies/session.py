"""A session of a study: finished runs are skipped, stopped ones resumed and missing ones trained."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from platform import node

from headway.contracts.errors import HeadwayError
from headway.store.index import RunIndex
from headway.store.run_folder import RunRecord
from headway.wording import counted
from headway_launch.console.output import print_line
from headway_launch.experiments.experiment import Experiment
from headway_launch.runner.jobs import CellPlan
from headway_launch.runner.runner import EXIT_STOPPED, Runner
from headway_launch.studies.plan import StudyProgress, keep_plan, plan_cells


@dataclass(frozen=True)
class StudySession:
    """The work of one session on experiments of one study and one store."""

    experiments: tuple[Experiment, ...]
    progress: tuple[StudyProgress, ...]
    cells: tuple[CellPlan, ...]

    @classmethod
    def plan(cls, experiments: Sequence[Experiment], fresh: bool = False) -> "StudySession":
        """Return the session that completes `experiments`.

        `fresh`: ignore stored runs. Raises HeadwayError if a job cannot run.
        """
        config = experiments[0].config
        root = Path(config.store.root)
        index = RunIndex(root)
        rows = index.rows(config.study)
        for notice in index.notices.values():
            print_line(f"headway: {notice}")
        progress = [
            StudyProgress.untouched(experiment) if fresh else StudyProgress.of(root, experiment, rows)
            for experiment in experiments
        ]
        return cls(tuple(experiments), tuple(progress), tuple(plan_cells(progress)))

    def train(self, debug: bool = False, may_leave: bool = False) -> tuple[Runner, int]:
        """Train; return the runner and the exit code.

        Raises HeadwayError if the store cannot be used, and as `require_all_ended`.
        """
        runner = self.open_runner(debug)
        code = runner.run()
        if code != EXIT_STOPPED:
            require_all_ended(self.experiments[0].config.study, runner.left_to_others(), may_leave)
        return runner, code

    def open_runner(self, debug: bool) -> Runner:
        """Return a runner and store the session's plan. Raises HeadwayError if the store cannot be used."""
        config = self.experiments[0].config
        runner = Runner(self.cells, debug, plan_kept=True)
        keep_plan(Path(config.store.root), config.study, self.experiments)
        print_progress(config.study, self.progress)
        return runner


def print_progress(study: str, progress: Sequence[StudyProgress]) -> None:
    """Print how many runs are finished, resumed, trained elsewhere and new; nothing if all are new."""
    counts = {
        "finished and skipped": sum(len(each.finished) for each in progress),
        "to resume": sum(len(each.unfinished) for each in progress),
        "in other sessions": sum(len(each.elsewhere) for each in progress),
        "to train": sum(len(each.new) for each in progress),
    }
    if any(counts[kind] for kind in list(counts)[:3]):
        parts = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
        print_line(f"headway: {counted(sum(counts.values()), 'run')} of study {study}: {parts}")


def require_all_ended(study: str, left: Sequence[Path], may_leave: bool = False) -> None:
    """Raise HeadwayError, with what to do, if runs in the folders `left` to other sessions have not finished.

    `may_leave`: if all of these are still being trained, print the line instead. A killed session on another
    host cannot be recognised here.
    """
    records = [record for record in map(RunRecord.read, left) if record.settled_status != "FINISHED"]
    if not records:
        return
    held = {record.session for record in records if record.settled_status == "RUNNING"}
    holders = [f"process {session.pid} on {session.host}" for session in sorted(held, key=str)]
    line = f"{counted(len(records), 'run')} of study {study} not finished, in other sessions"
    line += f" ({', '.join(holders)})" if holders else ""
    line += "; repeat this command when these have ended"
    if any(session.host != node() for session in held):
        line += '; if one was killed, repeat it on that host or set "status": "KILLED" in its runs\' run.json'
    if not may_leave or any(record.settled_status != "RUNNING" for record in records):
        raise HeadwayError(line)
    print_line(f"headway: {line}")

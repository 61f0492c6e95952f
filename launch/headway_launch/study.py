"""The finished runs of a study, one a seed, and a word about the others."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from headway.configuration import suggestion
from headway.contracts.errors import HeadwayError
from headway_launch.telling import tell

if TYPE_CHECKING:
    from headway.store.index import RunRow


def finished_runs(root: Path, study: str) -> list["RunRow"]:
    """The newest finished run of each cell and seed of a study, the oldest first: a seed that was trained
    twice is one seed, not two. What is left out is told in a line.

    Raises HeadwayError if there is no such study or nothing in it has finished.
    """
    from headway.store import RunIndex

    rows = RunIndex(root).rows()
    studies = sorted({row.study for row in rows})
    if study not in studies:
        raise HeadwayError(f"there is no study {study!r} in {root}; {suggestion(study, studies)}")
    of_study = [row for row in rows if row.study == study]
    finished = [row for row in of_study if row.status == "FINISHED"]
    others = Counter(row.status for row in of_study if row.status != "FINISHED")
    kinds = ", ".join(f"{count} {status}" for status, count in sorted(others.items()))
    if not finished:
        raise HeadwayError(f"study {study!r} has no finished run ({kinds}); see headway runs --study {study}")
    newest = {(row.cell, row.seed): row for row in finished}
    left_out = [f"{others.total()} not finished ({kinds})"] if others else []
    if repeats := len(finished) - len(newest):
        left_out.append(f"{repeats} of a seed that a newer one trained again")
    if left_out:
        tell(f"headway: runs of {study} left out: {', '.join(left_out)}")
    return [row for row in finished if newest[row.cell, row.seed] is row]

"""Episodes of best policies that `headway compare --best --keep` stores beside the runs, for reports."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import read_json, write_json
from headway.store.run_folder import best_file
from headway.wording import counted
from headway_launch.console.output import print_line

if TYPE_CHECKING:
    import pandas as pd

    from headway.events import Row
    from headway.store.index import RunRow
    from headway_launch.runner.stored_run import StoredRun


def require_other_episodes(root: int, cells: Mapping[str, Sequence["StoredRun"]]) -> None:
    """Raise HeadwayError if episodes of this root selected the best policies of a learner."""
    for label, members in cells.items():
        if members[0].experiment.config.evaluation.seed == root:
            raise HeadwayError(
                f"--keep: the episodes of --seed {root} selected the policies of {label}, on which their "
                "return is too high; give another --seed"
            )


def keep_episodes(
    members: Sequence["StoredRun"],
    iterations: Sequence[int],
    played: Sequence[Sequence["Row"]],
    rules: Mapping[str, Sequence["Row"]],
    root: int,
    mode: str,
) -> None:
    """Store the episodes of a learner's best policies and of the rules, from the seeds of `root`.

    `iterations` (seeds,): of the policies; `played`: seeds x episodes. Other runs and rules keep theirs if
    these are the same episodes, and else lose them, which a line says. Raises HeadwayError if the file cannot
    be written.
    """
    record = members[0].record
    path = best_file(members[0].store, record.study, record.cell)
    runs = {
        run.record.run_id: {"iteration": iteration, "episodes": list(episodes)}
        for run, iteration, episodes in zip(members, iterations, played, strict=True)
    }
    kept: dict[str, Any] = {"seed": root, "mode": mode, "rules": dict(rules), "runs": runs}
    before, stored = None, dict[str, dict[str, Any]]()
    with suppress(AttributeError, HeadwayError, KeyError, TypeError):  # missing or damaged
        content = read_json(path)
        before, stored = _episodes(content), {part: {**content[part]} for part in ("runs", "rules")}
    if before == _episodes(kept):
        kept |= {part: stored[part] | kept[part] for part in stored}
    else:
        others = {part: len(stored[part].keys() - kept[part].keys()) for part in stored}
        lost = " and ".join(counted(count, f"other {part[:-1]}") for part, count in others.items() if count)
        if lost:
            reason = "they were played with another --episodes, --seed or --mode"
            print_line(f"headway: removed the kept episodes of {lost}: {reason}")
    write_json(path, kept)


def _episodes(kept: Mapping[str, Any]) -> tuple[int, str, set[int]]:
    """Return the root of the seeds, the mode, and the numbers of episodes of the runs."""
    return kept["seed"], kept["mode"], {len(run["episodes"]) for run in kept["runs"].values()}


def kept_episodes(
    members: Sequence["RunRow"], mode: str, columns: Sequence[str]
) -> tuple[dict[str, "pd.DataFrame"], dict[str, "pd.DataFrame"]]:
    """Return the stored episodes, one per row, with `columns`.

    The first mapping holds those of the best policies of `members`, runs of one cell, by `run_id`; the second
    those of the rules. Both are empty if none of this mode are stored. Raises HeadwayError for a damaged
    file, and if a metric of `columns` is missing.
    """
    import pandas as pd

    path = best_file(Path(members[0].directory).parents[1], members[0].study, members[0].cell)
    if not path.exists():
        return {}, {}
    kept = read_json(path)
    try:
        if kept["mode"] != mode:
            return {}, {}
        runs = {row.run_id: kept["runs"][row.run_id] for row in members if row.run_id in kept["runs"]}
        return (
            {run_id: pd.DataFrame(run["episodes"])[columns].astype(float) for run_id, run in runs.items()},
            {rule: pd.DataFrame(rows)[columns].astype(float) for rule, rows in kept["rules"].items()},
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise HeadwayError(
            f"{path} is damaged or lacks {' or '.join(columns)}; write it again with "
            "`headway compare --best --keep`"
        ) from error

"""Any selection of runs as pandas frames: curves, episodes, evaluations, energy, summaries, rules.

    chosen = select("runs", study="bus", algorithm=("ippo", "mappo"), status="FINISHED", newest=True)
    chosen.curves(["evaluation_greedy/return"])

Which runs there are is answered by the index; of the logs only the columns asked for are read. Every frame
begins with the columns of `LABELS`, which say whose row it is.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.config.schema import suggestion
from headway.contracts import HeadwayError
from headway.store.atomic_files import read_json
from headway.store.cell_names import CellName, cell_names
from headway.store.energy_log import read_energy
from headway.store.index import RunIndex, RunRow
from headway.store.parquet_log import Table, read
from headway.store.run_folder import STATUSES, RunRecord, read_summary, rules_file

if TYPE_CHECKING:
    import pandas as pd

LABELS = ("run_id", "study", "cell", "label", "task", "controller", "seed")
"""`label` names the cell; `task` is what it is reported on and `controller` what plays there (`CellName`)."""
_ROW = (
    "environment",
    "algorithm",
    "policies",
    "preset",
    "status",
    "iterations",
    "env_steps",
    "started",
    "duration_s",
)
_READERS = 8
"""Threads that read logs at once: they mostly wait for the disk and for decompression."""

One = str | Sequence[str] | None
"""One value, several, or any."""


def select(
    root: str | Path,
    *,
    study: One = None,
    environment: One = None,
    algorithm: One = None,
    policies: One = None,
    preset: One = None,
    status: One = None,
    cell: One = None,
    run_id: One = None,
    seed: int | Sequence[int] | None = None,
    newest: bool = False,
) -> "RunSelection":
    """The runs in the store at `root` that pass all filters, the oldest first; each filter takes one value or
    several. With `newest`, of each cell and seed only the run that began last.

    Raises HeadwayError if there is no store, or a value that no run in it has (but for `status` and `seed`:
    those may well have none).
    """
    folder = Path(root)
    if not folder.is_dir():
        raise HeadwayError(f"there is no store in {str(root)!r}")
    everything = rows = RunIndex(folder).rows()
    wanted = {
        "study": study,
        "environment": environment,
        "algorithm": algorithm,
        "policies": policies,
        "preset": preset,
        "cell": cell,
        "run_id": run_id,
    }
    for name, value in wanted.items():
        if value is not None:
            allowed = _several(value)
            _require_known(name, allowed, [getattr(row, name) for row in everything], folder)
            rows = [row for row in rows if getattr(row, name) in allowed]
    if status is not None:
        statuses = _several(status)
        _require_known("status", statuses, STATUSES, folder)
        rows = [row for row in rows if row.status in statuses]
    if seed is not None:
        seeds = (seed,) if isinstance(seed, int) else tuple(seed)
        rows = [row for row in rows if row.seed in seeds]
    return RunSelection(folder, tuple(newest_runs(rows) if newest else rows))


def newest_runs(rows: Iterable[RunRow]) -> list[RunRow]:
    """Of each study, cell and seed the last of `rows`, which are in order: a seed that was trained twice is
    one seed, not two."""
    kept = list(rows)
    newest = {(row.study, row.cell, row.seed): row for row in kept}
    return [row for row in kept if newest[row.study, row.cell, row.seed] is row]


@dataclass(frozen=True)
class RunSelection:
    """Some runs of a store. Frames are read anew at each call; a frame without rows has no columns but those
    of `LABELS`. Methods raise HeadwayError for a file that cannot be read."""

    root: Path
    rows: tuple[RunRow, ...]

    @cached_property
    def names(self) -> Mapping[str, CellName]:
        """What the cells are called among each other."""
        return cell_names(self.rows)

    def runs(self) -> "pd.DataFrame":
        """One row a run: what the index knows of it, and nothing else read."""
        columns = (*_ROW, "final_reward", "auc", "kwh", "kg_co2", "directory")
        return self._frame([{name: getattr(row, name) for name in columns} for row in self.rows])

    def summaries(self) -> "pd.DataFrame":
        """One row a run: its figures at its end (rewards, energy by part, CPU seconds, how power is known)
        beside what it is. What a run has not is NaN."""
        rows = [
            {**{name: getattr(row, name) for name in _ROW}, **read_summary(Path(row.directory))}
            for row in self.rows
        ]
        return self._frame(rows)

    def provenance(self) -> "pd.DataFrame":
        """One row a run: the versions, the revision and the hardware that it was made with."""
        return self._frame([RunRecord.read(Path(row.directory)).tags for row in self.rows])

    def curves(self, metrics: Sequence[str] | None = None) -> "pd.DataFrame":
        """One row a point of a learning curve: `iteration`, `env_steps`, `wall_s` and metrics, `group/name`
        (all, or those named, where a run has them; rows that have none of them are left out)."""
        found = self._logs(
            "curve", None if metrics is None else ("iteration", "env_steps", "wall_s", *metrics)
        )
        known = [name for name in metrics or () if name in found.columns]
        if metrics is None:
            return found
        return found.dropna(subset=known, how="all").reset_index(drop=True) if known else found.iloc[:0]

    def evaluations(
        self, metrics: Sequence[str] | None = None, mode: str | None = None, final: bool | None = None
    ) -> "pd.DataFrame":
        """One row an evaluation episode: `iteration`, `env_steps`, `mode`, `final`, `episode_seed` (the day)
        and its figures; only of a `mode` (`greedy`, `sampled`), only the last evaluation (`final`) or only
        the others."""
        labels = ("iteration", "env_steps", "mode", "final", "episode_seed")
        found = self._logs("evaluation", None if metrics is None else (*labels, *metrics))
        if mode is not None and len(found):
            found = found[found["mode"] == mode]
        if final is not None and len(found):
            found = found[found["final"] == int(final)]
        return found.reset_index(drop=True)

    def episodes(self, metrics: Sequence[str] | None = None) -> "pd.DataFrame":
        """One row a training episode: `iteration`, `env_steps`, `copy` and its figures."""
        labels = ("iteration", "env_steps", "copy")
        return self._logs("episodes", None if metrics is None else (*labels, *metrics))

    def energy(self) -> "pd.DataFrame":
        """One row a sample: `time` (seconds since 1970) and, over all sessions until then, `kwh`, its parts,
        `kg_co2`, `cpu_seconds` and `duration_s`; no row of a run whose energy was not measured."""
        return self._each(read_energy)

    def rules(self) -> "pd.DataFrame":
        """One row a day of a classical rule: `task`, `rule`, `episode_seed` and its figures, of the rules
        kept beside these runs; of a rule and day that several cells of a task have, the first."""
        import pandas as pd

        rows: list[dict[str, Any]] = []
        for cell, study in dict.fromkeys((row.cell, row.study) for row in self.rows):
            path = rules_file(self.root, study, cell)
            if path.exists():
                for rule, days in read_json(path).items():
                    rows += [{"task": self.names[cell].task, "rule": rule, **day} for day in days]
        if not rows:
            return pd.DataFrame(columns=["task", "rule", "episode_seed"])
        return pd.DataFrame(rows).drop_duplicates(["task", "rule", "episode_seed"], ignore_index=True)

    def configurations(self) -> dict[str, str]:
        """The whole configuration of each run, as its `config.yaml` has it, by identity."""
        return {
            row.run_id: (Path(row.directory) / "config.yaml").read_text(encoding="utf-8") for row in self.rows
        }

    def _logs(self, table: Table, columns: Sequence[str] | None) -> "pd.DataFrame":
        return self._each(lambda directory: read(directory, table, columns=columns))

    def _each(self, read_one: Callable[[Path], "pd.DataFrame"]) -> "pd.DataFrame":
        import pandas as pd

        with ThreadPoolExecutor(_READERS) as readers:
            found = list(readers.map(lambda row: read_one(Path(row.directory)), self.rows))
        labelled = [
            self._labels(row, len(frame)).join(frame)
            for row, frame in zip(self.rows, found, strict=True)
            if len(frame)
        ]
        return pd.concat(labelled, ignore_index=True) if labelled else pd.DataFrame(columns=list(LABELS))

    def _labels(self, row: RunRow, count: int) -> "pd.DataFrame":
        import pandas as pd

        return pd.DataFrame([self._label(row)] * count, columns=list(LABELS))

    def _label(self, row: RunRow) -> dict[str, str | int]:
        name = self.names[row.cell]
        return {
            "run_id": row.run_id,
            "study": row.study,
            "cell": row.cell,
            "label": name.label,
            "task": name.task,
            "controller": name.controller,
            "seed": row.seed,
        }

    def _frame(self, figures: Sequence[Mapping[str, Any]]) -> "pd.DataFrame":
        import pandas as pd

        rows = [{**self._label(run), **of_run} for run, of_run in zip(self.rows, figures, strict=True)]
        return pd.DataFrame(rows) if rows else pd.DataFrame(columns=list(LABELS))


def _several(value: str | Sequence[str]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)


def _require_known(name: str, wanted: Sequence[str], known: Iterable[str], root: Path) -> None:
    there = set(known)
    for value in wanted:
        if value not in there:
            raise HeadwayError(f"no run in {root} has {name} {value!r}; {suggestion(value, there)}")

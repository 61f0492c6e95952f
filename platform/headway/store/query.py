"""Selected runs as pandas frames: curves, episodes, evaluations, energy, summaries, rules.

    chosen = select("runs", study="bus", algorithm=("ippo", "mappo"), status="FINISHED", newest=True)
    chosen.curves(["evaluation_greedy/return"])

Runs are listed by the index; only the requested columns of the logs are read. Every frame begins with the
columns of `LABELS`, which identify the run of a row.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Never

from headway.config.schema import suggestion
from headway.contracts import HeadwayError
from headway.store.cell_names import CellName, cell_names
from headway.store.energy_log import read_energy
from headway.store.index import RunIndex, RunRow
from headway.store.parquet_log import Table, read
from headway.store.run_folder import STATUSES, RunRecord, read_rules, read_summary

if TYPE_CHECKING:
    import pandas as pd

LABELS = ("run_id", "study", "cell", "label", "task", "controller", "seed")
"""Leading columns of every frame: `label`, `task` and `controller` are the fields of the cell's
`CellName`."""
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
"""Number of threads that read logs: they mostly wait for the disk and for decompression."""

Filter = str | Sequence[str] | None
"""One value, several values, or None: any."""


def select(
    root: str | Path,
    *,
    study: Filter = None,
    environment: Filter = None,
    algorithm: Filter = None,
    policies: Filter = None,
    preset: Filter = None,
    status: Filter = None,
    cell: Filter = None,
    run_id: Filter = None,
    seed: int | Iterable[int] | None = None,
    newest: bool = False,
    **others: Never,
) -> "RunSelection":
    """Select the runs in the store at `root` that pass all filters, oldest first.

    A filter is one value or several; `newest`: keep only the run of each cell and seed that started last.

    Raises HeadwayError for an unknown filter, if there is no store, or if no run has a given value (except
    for `status` and `seed`, which may match no run).
    """
    for name in others:
        raise HeadwayError(f"select has no filter {name!r}; {suggestion(name, select.__kwdefaults__ or ())}")
    folder = Path(root)
    if not folder.is_dir():
        raise HeadwayError(f"there is no store in {str(root)!r}")
    all_rows = rows = RunIndex(folder).rows()
    wanted = {
        "study": study,
        "environment": environment,
        "algorithm": algorithm,
        "policies": policies,
        "preset": preset,
        "cell": cell,
        "run_id": run_id,
        "status": status,
    }
    for name, value in wanted.items():
        if value is not None:
            allowed = (value,) if isinstance(value, str) else tuple(value)
            known = set(STATUSES if name == "status" else (getattr(row, name) for row in all_rows))
            for unknown in (each for each in allowed if each not in known):
                raise HeadwayError(f"no run in {folder} has {name} {unknown!r}; {suggestion(unknown, known)}")
            rows = [row for row in rows if getattr(row, name) in allowed]
    if seed is not None:
        seeds = tuple(seed) if isinstance(seed, Iterable) else (seed,)
        rows = [row for row in rows if row.seed in seeds]
    return RunSelection(folder, tuple(newest_runs(rows) if newest else rows))


def newest_runs(rows: Iterable[RunRow]) -> list[RunRow]:
    """Keep the last run of each study, cell and seed, so that a seed trained twice counts once.

    `rows` must be sorted oldest first.
    """
    candidates = list(rows)
    newest = {(row.study, row.cell, row.seed): row for row in candidates}
    return [row for row in candidates if newest[row.study, row.cell, row.seed] is row]


@dataclass(frozen=True)
class RunSelection:
    """Selected runs of a store.

    Each call reads its frame from disk; a frame without rows has only the columns of `LABELS`. Methods raise
    HeadwayError if a file cannot be read.
    """

    root: Path
    rows: tuple[RunRow, ...]
    beside: tuple[RunRow, ...] = ()
    """Further runs, from whose cells the names distinguish the selected ones too."""

    @cached_property
    def names(self) -> Mapping[str, CellName]:
        """Names of the cells by their keys, unique within the selection and `beside`."""
        return cell_names(self.rows, self.beside)

    def runs(self) -> "pd.DataFrame":
        """Return one row per run: its columns in the index; no other file is read."""
        columns = (*_ROW, "final_reward", "auc", "kwh", "kg_co2", "directory")
        return self._frame([{name: getattr(row, name) for name in columns} for row in self.rows])

    def summaries(self) -> "pd.DataFrame":
        """Return one row per run: its index columns and its final summary.

        The summary contains rewards, energy by component, CPU seconds and the source of the power readings. A
        missing value is NaN.
        """
        rows = [
            {**{name: getattr(row, name) for name in _ROW}, **read_summary(Path(row.directory))}
            for row in self.rows
        ]
        return self._frame(rows)

    def provenance(self) -> "pd.DataFrame":
        """Return one row per run: package versions, git revision and hardware."""
        return self._frame([RunRecord.read(Path(row.directory)).tags for row in self.rows])

    def curves(self, metrics: Sequence[str] | None = None) -> "pd.DataFrame":
        """Return one row per point of a learning curve: `iteration`, `env_steps`, `wall_s` and the metrics.

        `metrics`: columns `group/name` to read, ignored where a run lacks them; rows with none of them are
        dropped. None: all columns. Raises HeadwayError if there are curves, but none has any of `metrics`.
        """
        steps = ("iteration", "env_steps", "wall_s")
        found = self._logs("curve", None if metrics is None else tuple(dict.fromkeys((*steps, *metrics))))
        if metrics is None or found.empty:
            return found
        known = [name for name in metrics if name in found.columns]
        if metrics and not known:
            columns = [name for name in self._logs("curve", None).columns if "/" in name]
            asked = ", ".join(map(repr, metrics))
            raise HeadwayError(f"no curve has {asked}; {suggestion(metrics[0], columns)}")
        return found.dropna(subset=known, how="all").reset_index(drop=True)

    def evaluations(
        self, metrics: Sequence[str] | None = None, mode: str | None = None, final: bool | None = None
    ) -> "pd.DataFrame":
        """Return one row per evaluation episode.

        Columns: `iteration`, `env_steps`, `mode`, `final`, `episode_seed` and the metrics. `mode`: `greedy`
        or `sampled` only; `final`: True: the last evaluation only, False: the others only.
        """
        labels = ("iteration", "env_steps", "mode", "final", "episode_seed")
        found = self._logs("evaluation", None if metrics is None else (*labels, *metrics))
        if mode is not None and len(found):
            found = found[found["mode"] == mode]
        if final is not None and len(found):
            found = found[found["final"] == int(final)]
        return found.reset_index(drop=True)

    def episodes(self, metrics: Sequence[str] | None = None) -> "pd.DataFrame":
        """Return one row per training episode: `iteration`, `env_steps`, `copy` and its metrics."""
        labels = ("iteration", "env_steps", "copy")
        return self._logs("episodes", None if metrics is None else (*labels, *metrics))

    def energy(self) -> "pd.DataFrame":
        """Return one row per energy sample: `time` (seconds since 1970) and the totals so far.

        The totals are over all sessions: `kwh` and its components, `kg_co2`, `cpu_seconds`, `duration_s`.
        Runs without energy measurement have no rows.
        """
        return self._read_runs(read_energy)

    def rules(self, on_damage: Callable[[str], object] | None = None) -> "pd.DataFrame":
        """Return one row per episode of a classical rule, as stored with the runs' cells.

        Columns: `task`, `rule`, `episode_seed` and the metrics. An episode stored by several cells of a task
        appears once. `on_damage` gets the error of each damaged file, which is then left out; None: it is
        raised.
        """
        import pandas as pd

        rows: list[dict[str, Any]] = []
        stored = {(row.cell, row.study): Path(row.directory).parents[1] for row in self.rows}
        for (cell, study), root in stored.items():
            try:
                played = read_rules(root, study, cell)
            except HeadwayError as error:
                if on_damage is None:
                    raise
                on_damage(str(error))
                continue
            for rule, episodes in played.items():
                rows += [{"task": self.names[cell].task, "rule": rule, **episode} for episode in episodes]
        if not rows:
            return pd.DataFrame(columns=["task", "rule", "episode_seed"])
        return pd.DataFrame(rows).drop_duplicates(["task", "rule", "episode_seed"], ignore_index=True)

    def configurations(self) -> dict[str, str]:
        """Return the text of each run's `config.yaml`, its complete configuration, by `run_id`."""
        return {
            row.run_id: (Path(row.directory) / "config.yaml").read_text(encoding="utf-8") for row in self.rows
        }

    def _logs(self, table: Table, columns: Sequence[str] | None) -> "pd.DataFrame":
        return self._read_runs(lambda directory: read(directory, table, columns=columns))

    def _read_runs(self, read_one: Callable[[Path], "pd.DataFrame"]) -> "pd.DataFrame":
        import pandas as pd

        with ThreadPoolExecutor(_READERS) as readers:
            found = list(readers.map(lambda row: read_one(Path(row.directory)), self.rows))
        labelled = [
            pd.DataFrame([self._label(row)] * len(frame), columns=list(LABELS)).join(frame)
            for row, frame in zip(self.rows, found, strict=True)
            if len(frame)
        ]
        return pd.concat(labelled, ignore_index=True) if labelled else pd.DataFrame(columns=list(LABELS))

    def _label(self, row: RunRow) -> dict[str, str | int]:
        name = asdict(self.names[row.cell])
        return {"run_id": row.run_id, "study": row.study, "cell": row.cell, **name, "seed": row.seed}

    def _frame(self, columns: Sequence[Mapping[str, Any]]) -> "pd.DataFrame":
        import pandas as pd

        rows = [{**self._label(run), **own} for run, own in zip(self.rows, columns, strict=True)]
        return pd.DataFrame(rows) if rows else pd.DataFrame(columns=list(LABELS))

"""Parquet log of one run: the source of truth for its learning curve, episodes and evaluations.

A table is a sequence of segment files `TABLE-ITERATION.parquet`, each complete or absent: a killed run keeps
every committed row, and a resumed run removes the segments newer than its checkpoint.
"""

import numbers
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, get_args

from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.arrow_table import table_of
from headway.store.atomic_files import make_folder, remove_partial, require_regular, sync_folder
from headway.store.fencing import discard, write_through

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Table = Literal["curve", "episodes", "evaluation"]
TABLES: tuple[Table, ...] = get_args(Table)
_REQUIRED: Mapping[Table, tuple[str, ...]] = {
    "curve": ("iteration", "env_steps"),
    "episodes": ("iteration", "env_steps", "copy"),
    "evaluation": ("iteration", "env_steps", "mode", "episode_seed"),
}
"""Columns of every row."""
_SEGMENT = re.compile(r"(?P<table>[a-z]+)-(?P<iteration>\d{6,})\.parquet")
_RESTORE = "restore it, or remove this run's folder"


class RunLog:
    """Writer of the tables in a run's folder. One process writes; any number may read.

    `gate`: see `headway.store.fencing`; None: write without one.
    """

    def __init__(self, directory: Path, gate: Path | None = None) -> None:
        self.directory, self._gate = directory, gate
        make_folder(directory)
        for table in TABLES:
            remove_partial(directory, f"{table}-")
        self._rows: dict[Table, list[Row]] = {table: [] for table in TABLES}

    def append(self, table: Table, rows: Iterable[Row]) -> None:
        """Add rows of floats, integers and strings; `commit` makes them visible and durable.

        Raises ValueError, with the name of the column, for a value of another type.
        """
        self._rows[table].extend(
            {column: _plain(column, value) for column, value in row.items()} for row in rows
        )

    def commit(self, iteration: int) -> None:
        """Write all rows appended so far durably as the segments of `iteration`.

        Another commit at the same iteration extends its segments. Raises HeadwayError if a segment cannot be
        written (full disk, closed gate, ...); its rows are kept for a later commit. Raises ValueError if a
        column mixes text and numbers.
        """
        import pyarrow.parquet as pq

        for table, rows in self._rows.items():
            if not rows:
                continue
            path = self.directory / f"{table}-{iteration:06d}.parquet"
            content = table_of(rows)
            if path.exists():
                content = _concatenated([pq.read_table(path), content])

            def write(stream: IO[bytes], content: "pa.Table" = content) -> None:
                pq.write_table(content, stream, compression="zstd")

            write_through(path, write, self._gate)
            rows.clear()

    def rewind(self, iteration: int) -> None:
        """Remove all segments newer than `iteration` and all rows not yet committed.

        Raises HeadwayError if the gate has been closed.
        """
        for rows in self._rows.values():
            rows.clear()
        for _, newer, path in _segments(self.directory):
            if newer > iteration:
                discard(path, self._gate)
        sync_folder(self.directory)


def read(directory: Path, table: Table, columns: Sequence[str] | None = None) -> "pd.DataFrame":
    """Return the committed rows of a table.

    They are sorted by `iteration` (if that column exists), then in the order written; without rows the frame
    is empty. `columns`: columns to read, if they exist; None: all. Columns are float64 or int64 (float64 if
    some rows lack the column), `mode` is text; they may differ between segments. Raises HeadwayError if a
    segment cannot be read or has columns of other types, and if a curve's `env_steps` do not increase.
    """
    import pandas as pd
    import pyarrow as pa

    tables = _tables(directory, table, columns=columns)
    if not tables:
        return pd.DataFrame()
    frame: pd.DataFrame = pa.concat_tables(tables, promote_options="permissive").to_pandas()
    if "iteration" in frame.columns:
        frame = frame.sort_values("iteration", kind="stable", ignore_index=True)
    if table == "curve" and "env_steps" in frame.columns:
        _require_increasing(frame["env_steps"], directory)
    return frame


def read_rows(directory: Path, table: Table, after: int = -1) -> list[Row]:
    """Return the rows that `read` returns as mappings without missing values, without importing pandas.

    Segments up to iteration `after` are left out. Raises HeadwayError if a segment cannot be read, and if a
    curve's `env_steps` do not increase.
    """
    tables = _tables(directory, table, after)
    rows: list[Row] = [
        {column: value for column, value in row.items() if value is not None}
        for content in tables
        for row in content.to_pylist()
    ]
    rows.sort(key=lambda row: row["iteration"])
    if table == "curve":
        _require_increasing([row["env_steps"] for row in rows], directory)
    return rows


def require_readable(directory: Path) -> None:
    """Raise HeadwayError if the curve of a trained run is missing, or if it or the evaluations are damaged.

    Only the metadata of segments are read, in a sixth of the time of `read`, which also finds damaged rows,
    columns that are not of numbers, and `env_steps` that do not increase.
    """
    if not _tables(directory, "curve", columns=()):
        raise HeadwayError(f"{directory} has no curve-*.parquet: {_RESTORE}")
    _tables(directory, "evaluation", columns=())


def merged_segments(directory: Path, table: Table) -> "pa.Table | None":
    """Return the committed rows of a table, in the order written; None without rows.

    Raises HeadwayError if a segment cannot be read or has columns of other types.
    """
    tables = _tables(directory, table)
    return _concatenated(tables).combine_chunks() if tables else None


def read_curve(directory: Path, metric: str) -> dict[int, float]:
    """Return the learning curve of a metric: environment steps -> value."""
    rows = read_rows(directory, "curve")
    return {int(row["env_steps"]): float(row[metric]) for row in rows if metric in row}


def _tables(
    directory: Path, table: Table, after: int = -1, columns: Sequence[str] | None = None
) -> "list[pa.Table]":
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables, segments = [], _segments(directory, table)
    remedy = _remedy(table, len(segments))
    for _, iteration, path in segments:
        if iteration <= after:
            continue
        require_regular(path)
        try:
            segment = pq.ParquetFile(path)
            known = [name for name in columns or () if name in segment.schema_arrow.names]
            tables.append(segment.read(None if columns is None else known))
        except FileNotFoundError:
            continue  # removed by a rewind since the folder was listed
        except (OSError, pa.ArrowException) as error:
            raise HeadwayError(f"{path} cannot be read as Parquet: {remedy}") from error
        for column in _REQUIRED[table]:
            if column not in segment.schema_arrow.names:
                raise HeadwayError(f"{path} lacks column {column}: {remedy}")
            if pa.types.is_integer(segment.schema_arrow.field(column).type) == (column == "mode"):
                raise HeadwayError(f"{path}, column {column} has the wrong type: {remedy}")
            if column in tables[-1].column_names and tables[-1].column(column).null_count:
                raise HeadwayError(f"{path} lacks values of {column}: {remedy}")
        for column in tables[-1].schema:
            if column.name != "mode" and not _is_number(column.type):
                kind = f"of type {column.type}, not of numbers"
                raise HeadwayError(f"{path}, column {column.name} is {kind}: {remedy}")
    return tables


def _remedy(table: Table, segments: int) -> str:
    """Return what to do about a damaged one of a table's segments; a run without a curve cannot be used."""
    return _RESTORE if table == "curve" and segments == 1 else "remove it to use the rest"


def _is_number(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _require_increasing(env_steps: Iterable[Any], directory: Path) -> None:
    if not all(earlier < later for earlier, later in pairwise(env_steps)):
        raise HeadwayError(
            f"{directory}: the env_steps of its curve do not increase from row to row: a file "
            f"curve-*.parquet is damaged; {_remedy('curve', len(_segments(directory, 'curve')))}"
        )


def _segments(directory: Path, table: Table | None = None) -> list[tuple[str, int, Path]]:
    matches = ((_SEGMENT.fullmatch(path.name), path) for path in directory.glob("*.parquet"))
    found = [(match["table"], int(match["iteration"]), path) for match, path in matches if match]
    return sorted(entry for entry in found if table is None or entry[0] == table)


def _plain(column: str, value: Any) -> float | int | str:  # noqa: ANN401 - any type; checked here
    if isinstance(value, str):
        return str(value)
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real):
        return float(value)
    raise ValueError(f"column {column!r} holds {value!r}: rows hold floats, integers and strings only")


def _concatenated(tables: "list[pa.Table]") -> "pa.Table":
    import pyarrow as pa

    try:
        return pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowTypeError as error:
        raise ValueError(f"a column mixes text and numbers between segments: {error}") from error

"""Energy samples of one run, in `energy.parquet`."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.arrow_table import table_of
from headway.store.atomic_files import require_regular, write_durably

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

ENERGY = "energy.parquet"
"""Name of the file."""
_WRITE_SECONDS = 60.0


class EnergyLog:
    """Energy samples of a run, those of earlier sessions included; each write rewrites the file."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / ENERGY
        self._rows: list[Row] = []
        self._loaded = False
        self._written = time.monotonic()

    def append(self, sample: Row) -> None:
        """Add one sample; `write` makes it durable."""
        self._rows.append(sample)

    def last(self) -> Row:
        """Return the last sample, possibly from an earlier session; empty if there is none.

        Raises HeadwayError if the samples of earlier sessions cannot be read.
        """
        self._load()
        return self._rows[-1] if self._rows else {}

    def write_if_due(self) -> None:
        """Write if the last write is at least a minute ago. Raises HeadwayError if that fails."""
        if time.monotonic() - self._written >= _WRITE_SECONDS:
            self.write()

    def write(self) -> None:
        """Write all samples durably. Raises HeadwayError if that fails."""
        if not self._rows:
            return
        import pyarrow.parquet as pq

        self._load()
        content = table_of(self._rows)
        write_durably(self._path, lambda stream: pq.write_table(content, stream, compression="zstd"))
        self._written = time.monotonic()

    def _load(self) -> None:
        if not self._loaded and self._path.exists():
            stored = _read(self._path).to_pylist()
            known = ({name: value for name, value in row.items() if value is not None} for row in stored)
            self._rows = [*known, *self._rows]
        self._loaded = True


def read_energy(directory: Path) -> "pd.DataFrame":
    """Return all samples of the run in `directory`, oldest first; an empty frame if it has none.

    Raises HeadwayError if the file cannot be read.
    """
    import pandas as pd

    samples = energy_table(directory)
    return pd.DataFrame() if samples is None else samples.to_pandas()


def energy_table(directory: Path) -> "pa.Table | None":
    """Return the samples of `read_energy` as an Arrow table; None if the run has none."""
    path = directory / ENERGY
    return _read(path) if path.exists() else None


def _read(path: Path) -> "pa.Table":
    """Return the samples in a file. Raises HeadwayError if it cannot be read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    require_regular(path)
    try:
        samples = pq.ParquetFile(path).read()
    except (OSError, pa.ArrowException) as error:
        raise HeadwayError(f"{path} cannot be read as Parquet: remove it to use the rest") from error
    for column in samples.schema:
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            raise HeadwayError(f"{path} has text in column {column.name}: remove it to use the rest")
    return samples

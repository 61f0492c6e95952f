"""Arrow tables of rows, made without pandas.

`pa.array` and `pa.table` import pandas where it is installed, which takes every process half a CPU second.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from headway.events import Row

if TYPE_CHECKING:
    import pyarrow as pa


def table_of(rows: Sequence[Row]) -> "pa.Table":
    """Return a table with a column for each key of `rows`, of text, int64 or float64; null where a row lacks
    it. Raises ValueError if a column mixes text and numbers."""
    import pyarrow as pa

    columns = dict.fromkeys(column for row in rows for column in row)
    return pa.table({column: _column(column, [row.get(column) for row in rows]) for column in columns})


def _column(name: str, values: Sequence[float | int | str | None]) -> "pa.Array":
    import pyarrow as pa

    known = np.array([value is not None for value in values])
    validity = None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    are_text = {isinstance(value, str) for value in values if value is not None}
    if are_text == {True, False}:
        raise ValueError(f"column {name!r} mixes text and numbers: give it one type")
    if True in are_text:
        texts = [b"" if value is None else str(value).encode() for value in values]
        offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        buffers = [validity, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))]
        return pa.Array.from_buffers(pa.string(), len(values), buffers)
    numbers = np.array([0 if value is None else value for value in values])
    kind, dtype = (pa.float64(), np.float64) if numbers.dtype.kind == "f" else (pa.int64(), np.int64)
    return pa.Array.from_buffers(kind, len(values), [validity, pa.py_buffer(numbers.astype(dtype))])

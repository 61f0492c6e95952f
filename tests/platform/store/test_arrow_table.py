"""Tables of rows: as pyarrow itself would make them."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

from headway.events import Row
from headway.store.arrow_table import table_of

ROWS: list[Row] = [
    {"iteration": 1, "return": 0.5, "mode": "größer"},
    {"iteration": 2, "return": 2, "mode": ""},
    {"iteration": 3, "late": 7, "seed": np.int64(3), "cost": np.float64(1.7)},
]


def test_a_table_equals_that_of_pyarrow() -> None:
    columns = dict.fromkeys(name for row in ROWS for name in row)
    expected = pa.table({name: [row.get(name) for row in ROWS] for name in columns})
    assert table_of(ROWS).equals(expected)
    assert table_of(ROWS).to_pylist() == [{name: row.get(name) for name in columns} for row in ROWS]


def test_text_and_numbers_in_one_column_are_refused() -> None:
    with pytest.raises(ValueError, match="'mode' mixes text and numbers"):
        table_of([{"mode": "greedy"}, {"mode": 1.0}])


def test_pandas_is_not_imported() -> None:
    code = (
        "import sys; from headway.store.arrow_table import table_of; "
        "table_of([{'a': 1.0}, {'b': 'text'}]); print('pandas' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"

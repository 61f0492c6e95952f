"""Energy samples of earlier sessions, as they are read again."""

import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from headway.contracts import HeadwayError
from headway.store.energy_log import EnergyLog, read_energy


@pytest.mark.parametrize("damage", ["text", "pipe", "text in a column"])
def test_a_damaged_file_is_named_to_readers_and_to_a_resumed_session(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "energy.parquet"
    if damage == "text":
        path.write_text("[" * 100)
    elif damage == "text in a column":
        pq.write_table(pa.table({"kwh": ["much", "more"]}), path)
    else:
        os.mkfifo(path)
    for read in (lambda: read_energy(tmp_path), lambda: EnergyLog(tmp_path).last()):
        with pytest.raises(HeadwayError, match=r"energy\.parquet .*: remove it"):
            read()

"""Energy samples of earlier sessions, as they are read again."""

import os
from pathlib import Path

import pytest

from headway.contracts import HeadwayError
from headway.store.energy_log import EnergyLog, read_energy


@pytest.mark.parametrize("damage", ["text", "pipe"])
def test_a_damaged_file_is_named_to_readers_and_to_a_resumed_session(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "energy.parquet"
    if damage == "text":
        path.write_text("[" * 100)
    else:
        os.mkfifo(path)
    for read in (lambda: read_energy(tmp_path), lambda: EnergyLog(tmp_path).last()):
        with pytest.raises(HeadwayError, match=r"energy\.parquet .*: remove it"):
            read()

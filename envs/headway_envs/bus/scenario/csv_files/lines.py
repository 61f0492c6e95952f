"""Lines of an operator's CSV files: the stops of each direction, and the calls that other files refer to."""

from pathlib import Path

import numpy as np
import pandas as pd

from headway_envs.bus.scenario.csv_files.files import read_file, refuse

_DIRECTION = ["line", "direction"]


def read_lines(folder: Path) -> pd.DataFrame:
    """Return the rows of lines.csv by direction, with `pattern` (one per direction) and `seq0`."""
    lines = read_file(folder, "lines")
    lines["pattern"] = lines.groupby(_DIRECTION).ngroup()
    lines["seq0"] = lines.groupby("pattern").cumcount()
    single = lines.groupby("pattern")["seq0"].transform("size") < 2
    refuse("lines", lines, "stop", single, "is the only stop of its direction; add the others")
    return lines.sort_values(["pattern", "seq0"])


def place_calls(rows: pd.DataFrame, name: str, lines: pd.DataFrame) -> pd.DataFrame:
    """Return rows of NAME.csv with `pattern` and, if they name a stop, `seq0`.

    Raises HeadwayError for a direction or stop that is not in lines.csv, and for a stop where its direction
    calls several times and no position is given.
    """
    pattern = lines.groupby(_DIRECTION)["pattern"].first().reindex(pd.MultiIndex.from_frame(rows[_DIRECTION]))
    unknown = pattern.isna().to_numpy()
    refuse(name, rows, "direction", unknown, "is not a direction of this line in lines.csv; correct it")
    rows = rows.assign(pattern=pattern.to_numpy(np.int64))
    if "stop" not in rows:
        return rows
    calls = lines.groupby(["pattern", "stop"])["seq0"]
    keys = pd.MultiIndex.from_frame(rows[["pattern", "stop"]])
    count, first = calls.size().reindex(keys).to_numpy(), calls.first().reindex(keys).to_numpy()
    refuse(name, rows, "stop", np.isnan(count), "is not a stop of this direction in lines.csv; correct it")
    several = (count > 1) & rows["position"].isna()
    refuse(
        name,
        rows,
        "stop",
        several,
        "has several calls: add a column position, 1 for the first row in lines.csv",
    )
    seq0 = (rows["position"] - 1).where(rows["position"].notna(), first).to_numpy(np.int64)
    there = pd.MultiIndex.from_frame(lines[["pattern", "stop", "seq0"]])
    wrong = ~pd.MultiIndex.from_arrays([rows["pattern"], rows["stop"], seq0]).isin(there)
    refuse(name, rows, "position", wrong, "is not the position of this stop in lines.csv; correct it")
    return rows.assign(seq0=seq0)

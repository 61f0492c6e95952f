"""Views of a run for a browser, which cannot show Parquet: curves as a picture, evaluations as CSV."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from headway.events import Row
from headway.store.atomic_files import write_durably, write_text
from headway.store.parquet_log import read_rows

_PICTURE, _TABLE = "curves.png", "evaluations.csv"
_LABELS = ("iteration", "env_steps", "wall_s")
_DRAWN = ("evaluation_greedy/return", "evaluation_sampled/return", "training/return")


def write_views(directory: Path, title: str, into: Path) -> list[Path]:
    """Write the picture and the table of the run in `directory` into a folder; return their paths.

    Write nothing if the run has no curve yet. Raises HeadwayError if its log cannot be read or a file cannot
    be written.
    """
    written = []
    rows = read_rows(directory, "curve")
    evaluated = [row for row in rows if any(name.startswith("evaluation_") for name in row)]
    if evaluated:
        written.append(into / _TABLE)
        write_text(written[-1], _table(evaluated))
    curves = {
        name.replace("/", ": ").replace("_", " "): points
        for name in _DRAWN
        if (points := {int(row["env_steps"]): float(row[name]) for row in rows if name in row})
    }
    if curves:
        from headway.stats import plots

        figure = plots.run_curves(curves, title)
        written.append(into / _PICTURE)
        write_durably(written[-1], lambda stream: figure.savefig(stream, format="png", dpi=100))
    return written


def _table(rows: Sequence[Row]) -> str:
    columns = [
        *_LABELS,
        *dict.fromkeys(name for row in rows for name in row if name.startswith("evaluation_")),
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()

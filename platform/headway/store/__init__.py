"""Experiment store: run folders are the source of truth; MLflow and an index are derived from them.

A training process writes `RunLog` and checkpoints; the session process writes the rest through
`SessionStore`. `select` returns any runs as pandas frames. Importing this package imports none of MLflow,
pandas, pyarrow and torch.
"""

from headway.store.checkpoint import load_latest, save_checkpoint
from headway.store.index import RunIndex, RunRow
from headway.store.parquet_log import RunLog, Table, read
from headway.store.provenance import provenance
from headway.store.query import RunSelection, select
from headway.store.run_folder import CHECKPOINTS, RunRecord, Status, find_run
from headway.store.session import Cell, Run, SessionStore
from headway.store.tracking.sync import sync, sync_each

__all__ = [
    "CHECKPOINTS",
    "Cell",
    "Run",
    "RunIndex",
    "RunLog",
    "RunRecord",
    "RunRow",
    "RunSelection",
    "SessionStore",
    "Status",
    "Table",
    "find_run",
    "load_latest",
    "provenance",
    "read",
    "save_checkpoint",
    "select",
    "sync",
    "sync_each",
]

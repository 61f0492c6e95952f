"""The runs of a study as files of an archive: tables in one piece each, without names of machines."""

import io
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.config.experiment import BackendConfig, StoreConfig
from headway.contracts import HeadwayError
from headway.store.atomic_files import read_json
from headway.store.checkpoint import newest_file
from headway.store.energy_log import ENERGY, energy_table
from headway.store.index import RunRow
from headway.store.parquet_log import TABLES, merged_segments
from headway.store.run_configuration import read_configuration
from headway.store.run_folder import (
    CHECKPOINTS,
    RECORD,
    SUMMARY,
    Process,
    RunRecord,
    best_file,
    cell_summary_file,
    rules_file,
)
from headway.store.run_plan import PLAN
from headway.store.tracking.cells import CellSummary

if TYPE_CHECKING:
    import pyarrow as pa

_NOWHERE = Process("", 0, 0.0)
"""In place of the session process that trained a run."""
_HOST = "hardware.host"


def study_files(
    root: Path, rows: Sequence[RunRow], with_checkpoints: Collection[str]
) -> Iterator[tuple[str, bytes]]:
    """Yield (name, content) of the files of runs and of their cells, run after run.

    A table has one file, and `with_checkpoints` names the runs whose newest checkpoint is included. The
    host's name, the process, the store's folder, the cluster's address and MLflow's are left out. Raises
    HeadwayError if a file cannot be read.
    """
    for row in sorted(rows, key=lambda row: (row.study, row.run_id)):
        folder = Path(row.directory)
        for name, content in _run_files(folder, row.run_id in with_checkpoints):
            yield f"runs/{folder.parent.name}/{folder.name}/{name}", content
    for study, cell in sorted({(row.study, row.cell) for row in rows}):
        for path in (rules_file(root, study, cell), best_file(root, study, cell)):
            if path.exists():
                yield f"runs/{path.parent.name}/{path.name}", _json(read_json(path))
        if (path := cell_summary_file(root, study, cell)).exists():
            summary = replace(CellSummary.read(path), session=_NOWHERE, tracking_uri=None, sent=())
            yield f"runs/{path.parent.name}/{path.name}", _json(asdict(summary))


def _run_files(folder: Path, with_checkpoint: bool) -> Iterator[tuple[str, bytes]]:
    import yaml

    record = RunRecord.read(folder)
    tags = {name: value for name, value in record.tags.items() if name != _HOST}
    yield RECORD, _json(asdict(replace(record, session=_NOWHERE, tracking_uri=None, tags=tags)))
    yield "config.yaml", yaml.safe_dump(_portable(read_configuration(folder)), sort_keys=False).encode()
    yield PLAN, _json(read_json(folder / PLAN))
    if (folder / SUMMARY).exists():
        yield SUMMARY, _json(read_json(folder / SUMMARY))
    for table in TABLES:
        if (rows := merged_segments(folder, table)) is not None:
            yield f"{table}-{record.durable_iteration:06d}.parquet", _parquet(rows)
    if (samples := energy_table(folder)) is not None:
        yield ENERGY, _parquet(samples)
    if with_checkpoint:
        path = newest_file(folder / CHECKPOINTS)
        if path is None:
            raise HeadwayError(f"run {folder.name} has no checkpoint: archive without --checkpoints")
        yield f"{CHECKPOINTS}/{path.name}", path.read_bytes()


def _portable(config: Mapping[str, Any]) -> dict[str, Any]:
    store = {**config.get("store", {}), "root": StoreConfig.root, "tracking_uri": None}
    backend = {**config.get("backend", {}), "address": BackendConfig.address}
    return {**config, "backend": backend, "store": store}


def _json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, default=str) + "\n").encode()


def _parquet(rows: "pa.Table") -> bytes:
    """Return the file of a table, a tenth of the size of the segments that it replaces."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    floats = [column.name for column in rows.schema if pa.types.is_floating(column.type)]
    stream = io.BytesIO()
    pq.write_table(
        rows,
        stream,
        compression="zstd",
        compression_level=9,
        use_dictionary=[name for name in rows.column_names if name not in floats],
        use_byte_stream_split=floats,
        write_statistics=False,
        store_schema=False,
    )
    return stream.getvalue()

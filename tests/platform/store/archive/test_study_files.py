"""An archived study reads as the store that it was made of, without names of the machine."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from headway.contracts import HeadwayError
from headway.store.archive.container import unpack, write_archive
from headway.store.archive.study_files import study_files
from headway.store.atomic_files import write_json, write_text
from headway.store.checkpoint import save_checkpoint
from headway.store.energy_log import EnergyLog
from headway.store.parquet_log import RunLog
from headway.store.query import RunSelection, select
from headway.store.run_folder import Process, RunRecord, create_run_folder, now, rules_file
from headway.store.tracking.cells import CellSummary

HOST, USER = "node7.example", "/home/somebody/lab"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Store with two runs of two segments each, and what stands beside them."""
    root, session = tmp_path / "runs", Process(HOST, 1, 1.0)
    for seed in (0, 1):
        run_id, folder = create_run_folder(root, "lines", "cell", seed)
        tags = {"hardware.host": HOST, "version.numpy": "2.0"}
        record = RunRecord(run_id, "lines", "trivial", "ippo", seed, 2, now(), session, "FINISHED", tags=tags)
        record = replace(record, durable_iteration=2, tracking_uri=f"http://{HOST}:5000")
        record.write(folder)
        write_text(
            folder / "config.yaml",
            f"store: {{root: {USER}/runs, tracking_uri: 'http://{HOST}:5000', curve_points: 7}}\n"
            f"backend: {{name: ray, address: '{HOST}:6379'}}\nalgo: {{name: ippo, lr: 0.001}}\n",
        )
        write_json(folder / "plan.json", {"stack": [0, 1]})
        write_json(folder / "summary.json", {"final_reward": 2.5 + seed, "kwh": None})
        log = RunLog(folder)
        for iteration in (1, 2):
            at = {"iteration": iteration, "env_steps": 10 * iteration}
            log.append("curve", [{**at, "training/return": 0.1 * iteration + seed}])
            late = {"mean_wait_min": 1.5} if iteration == 2 else {}
            log.append("episodes", [{**at, "copy": 0, "length": iteration, **late}])
            log.append("evaluation", [{**at, "mode": "greedy", "episode_seed": 3, "return": 1 / 3}])
            log.commit(iteration)
        energy = EnergyLog(folder)
        energy.append({"time": 1.0, "kwh": 0.25})
        energy.write()
        save_checkpoint(folder / "checkpoints", 1, {"acting": {}})
        save_checkpoint(folder / "checkpoints", 2, {"acting": {}, "seed": seed})
    write_json(rules_file(root, "lines", record.cell), {"always": [{"episode_seed": 3, "return": 0.5}]})
    CellSummary("lines", record.cell, {}, session, f"http://{HOST}:5000", "FINISHED", now()).keep(root)
    return root


def archived(root: Path, file: Path, checkpoints: bool = False) -> RunSelection:
    """Archive a store, unpack the archive beside it, and return its runs."""
    rows = select(root).rows
    write_archive(
        file, {"study": "lines"}, study_files(root, rows, {row.run_id for row in rows} if checkpoints else ())
    )
    unpack(file, file.with_suffix(""))
    return select(file.with_suffix(""))


@pytest.mark.parametrize(
    "read",
    [RunSelection.curves, RunSelection.episodes, RunSelection.evaluations, RunSelection.energy,
     RunSelection.rules, RunSelection.summaries],
)  # fmt: skip
def test_every_table_is_that_of_the_store(
    read: Callable[[RunSelection], pd.DataFrame], root: Path, tmp_path: Path
) -> None:
    expected, found = read(select(root)), read(archived(root, tmp_path / "lines.zip"))
    assert len(expected) > 0
    pd.testing.assert_frame_equal(found, expected, check_exact=True)


def test_a_table_is_one_file_with_every_column(root: Path, tmp_path: Path) -> None:
    for row in archived(root, tmp_path / "lines.zip").rows:
        files = sorted(path.name for path in Path(row.directory).glob("*.parquet"))
        tables = ("curve", "episodes", "evaluation")
        assert files == sorted(["energy.parquet", *(f"{name}-000002.parquet" for name in tables)])
        episodes = pq.read_table(Path(row.directory, "episodes-000002.parquet")).to_pydict()
        assert episodes["mean_wait_min"] == [None, 1.5]


def test_neither_the_host_nor_a_folder_of_it_is_named(root: Path, tmp_path: Path) -> None:
    found = archived(root, tmp_path / "lines.zip", checkpoints=True)
    for path in found.root.rglob("*"):
        if path.is_file() and path.suffix != ".sqlite":
            content = path.read_bytes()
            assert HOST.encode() not in content, path
            assert USER.encode() not in content, path
    [before, _], [after, _] = (
        [asdict(RunRecord.read(Path(row.directory))) for row in each.rows] for each in (select(root), found)
    )
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {"session", "tracking_uri", "tags"}
    assert after["tags"] == {"version.numpy": "2.0"}
    config = found.configurations()[str(after["run_id"])]
    assert "curve_points: 7" in config
    assert "lr: 0.001" in config


def test_the_newest_checkpoint_is_there_if_asked_for(root: Path, tmp_path: Path) -> None:
    without = archived(root, tmp_path / "without.zip").root
    assert not list(without.rglob("*.pt"))
    found = archived(root, tmp_path / "with.zip", checkpoints=True).root
    expected = {path.relative_to(root): path.read_bytes() for path in root.rglob("*-000002.pt")}
    assert {path.relative_to(found): path.read_bytes() for path in found.rglob("*.pt")} == expected


def test_a_missing_checkpoint_is_named(root: Path, tmp_path: Path) -> None:
    for path in root.rglob("*.pt"):
        path.unlink()
    with pytest.raises(HeadwayError, match=r"has no checkpoint: archive without --checkpoints"):
        archived(root, tmp_path / "with.zip", checkpoints=True)

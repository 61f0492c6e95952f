"""The summary index matches the run folders, even after it was damaged."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from stored_runs import keep

from headway.store.atomic_files import write_json
from headway.store.index import RunIndex, RunRow, _prepare, _row
from headway.store.run_folder import RunRecord, read_summary


def _run(root: Path, seed: int, study: str = "study", **summary: float | None) -> Path:
    return keep(root, study, seed, "bus", "mappo", "bus-mappo", summary)


def test_rows_match_the_folders(tmp_path: Path) -> None:
    _run(tmp_path, 0, final_reward=1.5, kwh=float("nan"), auc=None)
    _run(tmp_path, 1, study="other", final_reward=2.5)
    first, second = RunIndex(tmp_path).rows()
    assert (first.seed, first.final_reward, first.auc, first.kwh) == (0, 1.5, None, None)
    assert RunIndex(tmp_path).rows("other") == [second]
    assert RunIndex(tmp_path / "absent").rows() == []


def test_changed_and_removed_runs_are_updated(tmp_path: Path) -> None:
    kept, removed = _run(tmp_path, 0), _run(tmp_path, 1)
    assert len(RunIndex(tmp_path).rows()) == 2
    shutil.rmtree(removed)
    replace(RunRecord.read(kept), durable_iteration=7).write(kept)
    write_json(kept / "summary.json", {"final_reward": 9.0})
    [row] = RunIndex(tmp_path).rows()
    assert (row.iterations, row.final_reward) == (7, 9.0)


@pytest.mark.parametrize("damage", ["lost", "corrupt", "stale", "of another version"])
def test_a_damaged_index_is_rebuilt(tmp_path: Path, damage: str) -> None:
    _run(tmp_path, 0, final_reward=1.0)
    expected = RunIndex(tmp_path).rows()
    path = tmp_path / "index.sqlite"
    old = path.read_bytes()
    if damage == "lost":
        path.unlink()
    elif damage == "corrupt":
        path.write_bytes(old[:100] + b"\xff" * 5000)
    elif damage == "stale":
        _run(tmp_path, 1)
        expected = RunIndex(tmp_path).rows()
        path.write_bytes(old)
    else:
        with sqlite3.connect(path) as database:
            database.execute("DROP TABLE runs")
            database.execute("PRAGMA user_version = 99")
    assert RunIndex(tmp_path).rows() == expected


def test_a_locked_index_does_not_block_a_query(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("headway.store.index._WAIT_SECONDS", 0.1)
    _run(tmp_path, 0)
    RunIndex(tmp_path).rows()
    other = sqlite3.connect(tmp_path / "index.sqlite", isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    _run(tmp_path, 1)
    assert len(RunIndex(tmp_path).rows()) == 2
    other.close()


def test_an_index_that_another_process_has_just_made_is_kept(tmp_path: Path) -> None:
    """The other process may still have to read its rows."""
    _run(tmp_path, 5)

    def make_before(statement: str) -> None:
        if statement == "BEGIN IMMEDIATE":
            RunIndex(tmp_path).rows()

    with closing(sqlite3.connect(tmp_path / "index.sqlite", isolation_level=None)) as database:
        database.set_trace_callback(make_before)
        _prepare(database)
        database.set_trace_callback(None)
        assert database.execute("SELECT seed FROM runs").fetchall() == [(5,)]


def test_a_broken_record_is_a_notice(tmp_path: Path) -> None:
    _run(tmp_path, 0)
    broken = _run(tmp_path, 1)
    (broken / "run.json").write_text('{"run_id": ')
    index = RunIndex(tmp_path)
    assert len(index.rows()) == 1
    assert index.notices[broken].startswith(f"{broken / 'run.json'} cannot be read")
    (broken / "run.json").write_text(json.dumps({"run_id": "x"}))
    index.rows()
    assert "is not a valid run record" in index.notices[broken]


def test_a_run_that_was_listed_is_left_out_while_its_record_is_broken(tmp_path: Path) -> None:
    """An index that has read the run before must not return its stored row."""
    record = _run(tmp_path, 0) / "run.json"
    [row] = RunIndex(tmp_path).rows()
    text = record.read_text()
    record.write_text(text[:40])
    index = RunIndex(tmp_path)
    for _ in range(2):
        assert index.rows() == []
        assert list(index.notices) == [record.parent]
    record.write_text(text)
    assert (index.rows(), index.notices) == ([row], {})


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"seed": 10**400}, "seed is a whole number beyond 2^63"),
        ({"seed": "three"}, "seed='three' is text"),
        ({"session": None}, "session=null is null"),
        ({"status": "DONE"}, "status='DONE' is not possible"),
        ({"started": "yesterday"}, "Invalid isoformat string: 'yesterday'"),
        ({"parameters": {"algo.lr": 1}}, "parameters.algo.lr=1 is a whole number"),
    ],
)
def test_wrong_values_in_records_are_notices(tmp_path: Path, change: dict[str, object], problem: str) -> None:
    """The other runs stay listed."""
    _run(tmp_path, 0)
    broken = _run(tmp_path, 1) / "run.json"
    broken.write_text(json.dumps(json.loads(broken.read_text()) | change))
    index = RunIndex(tmp_path)
    assert [row.seed for row in index.rows()] == [0]
    [notice] = index.notices.values()
    assert f"{broken} is not a valid run record ({problem}" in notice


@pytest.mark.parametrize("name", ["run.json", "summary.json"])
@pytest.mark.parametrize("damage", ["nested", "pipe", "device"])
def test_a_file_that_cannot_be_read_to_its_end_is_a_notice(tmp_path: Path, name: str, damage: str) -> None:
    _run(tmp_path, 0)
    path = _run(tmp_path, 1) / name
    path.unlink()
    if damage == "nested":
        path.write_text("[" * 100_000)
    elif damage == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    index = RunIndex(tmp_path)
    assert [row.seed for row in index.rows()] == [0]
    assert [str(path) in notice for notice in index.notices.values()] == [True]


def test_a_link_to_itself_hides_no_run(tmp_path: Path) -> None:
    _run(tmp_path, 0)
    for folder in (tmp_path, tmp_path / "study"):
        (folder / "loop").symlink_to("loop")
    assert [row.seed for row in RunIndex(tmp_path).rows()] == [0]


@pytest.mark.parametrize("value", [10**400, 2**63, 1e308, float("nan"), "/dev/zero", [1.0]])
def test_a_figure_that_is_no_number_is_left_out(tmp_path: Path, value: object) -> None:
    folder = _run(tmp_path, 0)
    summary = {"final_reward": value, "auc": 1.0, "energy.cpu": "estimated"}
    (folder / "summary.json").write_text(json.dumps(summary))
    [row] = RunIndex(tmp_path).rows()
    assert (row.final_reward, row.auc) == (None, 1.0)
    assert read_summary(folder) == {**summary, "final_reward": None}


def test_a_query_reads_only_changed_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Changes are detected by the times and sizes of the files."""
    folders = [_run(tmp_path, seed, final_reward=1.0) for seed in range(20)]
    read: list[Path] = []

    def counted(folder: Path) -> RunRow:
        read.append(folder)
        return _row(folder)

    monkeypatch.setattr("headway.store.index._row", counted)
    assert len(RunIndex(tmp_path).rows()) == 20
    assert sorted(read) == sorted(folders)
    read.clear()
    assert len(RunIndex(tmp_path).rows()) == 20
    assert read == []
    write_json(folders[7] / "summary.json", {"final_reward": 2.0})
    assert len(RunIndex(tmp_path).rows()) == 20
    assert read == [folders[7]]


_QUERY = """
import sys
from pathlib import Path
from headway.store.index import RunIndex
heavy = {"pandas", "mlflow", "pyarrow", "torch", "scipy"}
print(len(RunIndex(Path(sys.argv[1])).rows()), heavy & set(sys.modules))
"""


def test_a_query_imports_nothing_heavy(tmp_path: Path) -> None:
    _run(tmp_path, 0, final_reward=1.0)
    command = [sys.executable, "-c", _QUERY, str(tmp_path)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert answer == ["1", "set()"]

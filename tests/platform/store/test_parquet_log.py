"""Parquet log: committed rows survive a kill, uncommitted rows are invisible."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from headway.contracts import HeadwayError
from headway.events import Row
from headway.store import parquet_log
from headway.store.checkpoint import load_latest, save_checkpoint
from headway.store.parquet_log import RunLog


def _committed(folder: Path, values: dict[int, Any]) -> RunLog:
    """Return a log with one committed row per iteration."""
    run = RunLog(folder)
    for iteration, value in values.items():
        run.append("curve", [{"iteration": iteration, "env_steps": iteration, "x": value}])
        run.commit(iteration)
    return run


def test_rows_are_visible_after_commit_only(tmp_path: Path) -> None:
    run = RunLog(tmp_path)
    run.append("curve", [{"iteration": 1, "env_steps": 10, "train/reward": 0.5}])
    assert parquet_log.read(tmp_path, "curve").empty
    run.commit(1)
    frame = parquet_log.read(tmp_path, "curve")
    assert frame.to_dict("records") == [{"iteration": 1, "env_steps": 10, "train/reward": 0.5}]
    assert parquet_log.read(tmp_path, "episodes").empty


def test_columns_have_three_types_and_may_differ_between_segments(tmp_path: Path) -> None:
    run = RunLog(tmp_path)
    of_all = {"env_steps": 10, "episode_seed": 0}
    run.append("evaluation", [{"iteration": 2, **of_all, "mode": "greedy", "return": float(np.float32(1.5))}])
    run.commit(2)
    sampled: dict[str, Any] = {"iteration": np.int64(1), **of_all, "mode": "sampled", "length": np.int32(7)}
    run.append("evaluation", [sampled])
    run.commit(4)
    frame = parquet_log.read(tmp_path, "evaluation")
    assert list(frame["iteration"]) == [1, 2]
    assert frame["iteration"].dtype == np.int64
    assert frame["return"].dtype == np.float64
    assert list(frame["mode"]) == ["sampled", "greedy"]
    assert np.isnan(frame["return"][0])
    assert parquet_log.read_rows(tmp_path, "evaluation")[0] == sampled


def test_an_integer_column_may_become_floats_later(tmp_path: Path) -> None:
    _committed(tmp_path, {1: 3, 2: 0.25})
    assert list(parquet_log.read(tmp_path, "curve")["x"]) == [3.0, 0.25]


def test_a_curve_with_a_point_twice_is_refused(tmp_path: Path) -> None:
    run = RunLog(tmp_path)
    run.append("curve", [{"iteration": 1, "env_steps": 64, "x": 0.5}] * 2)
    run.commit(1)
    for read in (parquet_log.read, parquet_log.read_rows):
        with pytest.raises(HeadwayError, match="env_steps of its curve do not increase"):
            read(tmp_path, "curve")


def test_a_second_commit_of_an_iteration_extends_it(tmp_path: Path) -> None:
    run = RunLog(tmp_path)
    for value in (1.0, 2.0):
        run.append("curve", [{"iteration": 5, "env_steps": int(value), "x": value}])
        run.commit(5)
    assert list(parquet_log.read(tmp_path, "curve")["x"]) == [1.0, 2.0]
    assert len(list(tmp_path.glob("curve-*.parquet"))) == 1


def test_rewind_removes_rows_newer_than_the_checkpoint(tmp_path: Path) -> None:
    run = _committed(tmp_path, {10: 0, 20: 0, 30: 0})
    run.append("curve", [{"iteration": 31, "env_steps": 31}])
    run.rewind(20)
    run.commit(31)
    assert list(parquet_log.read(tmp_path, "curve")["iteration"]) == [10, 20]
    assert [row["iteration"] for row in parquet_log.read_rows(tmp_path, "curve", after=10)] == [20]


@pytest.mark.parametrize("value", [None, [1.0], object()])
def test_other_value_types_are_refused_with_the_column_name(tmp_path: Path, value: object) -> None:
    with pytest.raises(ValueError, match="'train/x'"):
        RunLog(tmp_path).append("curve", [{"train/x": value}])  # type: ignore[dict-item] # the bad input


def test_text_and_numbers_do_not_mix(tmp_path: Path) -> None:
    run = RunLog(tmp_path)
    run.append("curve", [{"x": 1.0}, {"x": "one"}])
    with pytest.raises(ValueError, match="'x' mixes"):
        run.commit(1)


def test_a_segment_of_other_types_is_named_by_its_column(tmp_path: Path) -> None:
    _committed(tmp_path, {1: 1.0, 2: "one"})
    with pytest.raises(HeadwayError, match=r"curve-000002\.parquet, column x is of type string"):
        parquet_log.read(tmp_path, "curve")


def test_a_full_disk_is_one_line_and_loses_no_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = _committed(tmp_path, {1: 0})
    run.append("curve", [{"iteration": 2, "env_steps": 2}])

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(HeadwayError, match="the disk is full") as raised:
            run.commit(2)
    assert "\n" not in str(raised.value)
    assert list(parquet_log.read(tmp_path, "curve")["iteration"]) == [1]
    run.commit(2)
    assert list(parquet_log.read(tmp_path, "curve")["iteration"]) == [1, 2]
    assert {path.suffix for path in tmp_path.iterdir()} == {".parquet"}


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)]
    if not shutil.which("mount") or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting a file system needs root")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=False)


def test_a_full_disk_keeps_committed_data(tiny_disk: Path) -> None:
    run, checkpoints = RunLog(tiny_disk / "run"), tiny_disk / "run" / "checkpoints"
    noise, kept = np.random.default_rng(0), [0]

    def fill() -> None:
        while kept[-1] < 1000:
            iteration = kept[-1] + 1
            rows: list[Row] = [
                {"iteration": iteration, "env_steps": 1000 * iteration + place, "x": value}
                for place, value in enumerate(noise.normal(size=1000))
            ]
            run.append("curve", rows)
            run.commit(iteration)
            save_checkpoint(checkpoints, iteration, {"at": iteration})
            kept.append(iteration)

    with pytest.raises(HeadwayError, match="free some space and resume"):
        fill()
    assert kept[-1] > 3
    assert parquet_log.read(tiny_disk / "run", "curve")["iteration"].max() >= kept[-1]
    assert load_latest(checkpoints)[1] == {"at": kept[-1]}
    assert not list((tiny_disk / "run").glob(".*"))


@pytest.mark.parametrize("column", ["iteration", "env_steps", "mode", "episode_seed"])
def test_a_segment_without_a_required_column_is_named(column: str, tmp_path: Path) -> None:
    row: Row = {"iteration": 1, "env_steps": 64, "mode": "greedy", "episode_seed": 0}
    run = RunLog(tmp_path)
    run.append("evaluation", [{name: value for name, value in row.items() if name != column}])
    run.commit(1)
    with pytest.raises(HeadwayError, match=rf"evaluation-000001\.parquet lacks column {column}: remove it"):
        parquet_log.read(tmp_path, "evaluation")
    run.append("evaluation", [{**row, column: 1 if column == "mode" else "\x1b[31m"}])
    run.commit(2)
    with pytest.raises(HeadwayError, match=rf"evaluation-00000\d\.parquet.* column {column}"):
        parquet_log.read_rows(tmp_path, "evaluation", after=1)
    run.append("evaluation", [row])
    run.commit(1)  # extends the segment: the first row lacks a value
    with pytest.raises(HeadwayError, match=rf"evaluation-000001\.parquet lacks values of {column}: remove"):
        parquet_log.read_rows(tmp_path, "evaluation")


def test_a_broken_segment_is_named(tmp_path: Path) -> None:
    (tmp_path / "curve-000001.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(HeadwayError, match=r"curve-000001\.parquet"):
        parquet_log.read(tmp_path, "curve")


_WRITER = """
import sys
from pathlib import Path
from headway.store.parquet_log import RunLog
run = RunLog(Path(sys.argv[1]))
for iteration in range(1, 100_000):
    steps = range(20 * iteration, 20 * iteration + 20)
    run.append("curve", [{"iteration": iteration, "env_steps": step, "x": 0.5} for step in steps])
    run.append("episodes", [{"iteration": iteration, "env_steps": steps[-1], "copy": 0}])
    run.commit(iteration)
    print(iteration, flush=True)
"""


def test_a_killed_writer_leaves_complete_segments(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _WRITER, str(tmp_path)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    acknowledged = [int(writer.stdout.readline()) for _ in range(25)][-1]
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    writer.stdout.close()

    iterations = parquet_log.read(tmp_path, "curve")["iteration"]
    assert iterations.max() >= acknowledged
    assert (iterations.value_counts() == 20).all()
    RunLog(tmp_path).rewind(acknowledged)
    assert sorted(set(parquet_log.read(tmp_path, "curve")["iteration"])) == list(range(1, acknowledged + 1))
    assert list(parquet_log.read(tmp_path, "episodes")["iteration"]) == list(range(1, acknowledged + 1))
    assert not list(tmp_path.glob(".*"))

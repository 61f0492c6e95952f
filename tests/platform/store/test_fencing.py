"""Fencing: a process whose gate was closed can change nothing in a run's folder."""

import errno
import multiprocessing
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest

from headway.contracts import HeadwayError
from headway.store.checkpoint import latest_iteration, load_latest, save_checkpoint, write_checkpoint
from headway.store.fencing import close_gates, discard, open_gate, write_through
from headway.store.parquet_log import RunLog, read_rows

TAKEN_OVER = "another training process has taken over"


def _filled(directory: Path, iteration: int, gate: Path | None = None) -> RunLog:
    log = RunLog(directory, gate)
    log.append("curve", [{"iteration": iteration, "env_steps": iteration, "reward": 0.5}])
    log.commit(iteration)
    return log


def _contents(directory: Path) -> dict[str, bytes]:
    files = (path for path in directory.rglob("*") if path.is_file())
    return {str(path.relative_to(directory)): path.read_bytes() for path in files}


def test_files_are_the_same_with_and_without_a_gate(tmp_path: Path) -> None:
    plain, gated = tmp_path / "plain", tmp_path / "gated"
    for directory in (plain, gated):
        directory.mkdir()
        gate = open_gate(directory) if directory == gated else None
        for iteration in (1, 2, 3):
            log = _filled(directory, iteration, gate)
            write_checkpoint(directory / "checkpoints", iteration, b"%d" % iteration, gate)
        log.rewind(2)
    close_gates(gated)
    assert _contents(gated) == _contents(plain)
    assert [path.name for path in gated.glob(".*")] == []


def test_a_former_writer_cannot_add_replace_or_remove_files(tmp_path: Path) -> None:
    before = open_gate(tmp_path)
    log = _filled(tmp_path, 2, before)
    log.append("curve", [{"iteration": 4, "env_steps": 4, "reward": 1.0}])
    after = open_gate(tmp_path)
    _filled(tmp_path, 4, after)
    save_checkpoint(tmp_path / "checkpoints", 4, {"iteration": 4})
    kept = _contents(tmp_path)
    with pytest.raises(HeadwayError, match=f"{TAKEN_OVER} {tmp_path}: this one ends"):
        log.commit(4)
    with pytest.raises(HeadwayError, match=TAKEN_OVER):
        log.rewind(0)
    with pytest.raises(HeadwayError, match=TAKEN_OVER):
        write_checkpoint(tmp_path / "checkpoints", 6, b"late", before)
    assert _contents(tmp_path) == kept
    assert [row["iteration"] for row in read_rows(tmp_path, "curve")] == [2, 4]
    assert load_latest(tmp_path / "checkpoints")[0] == latest_iteration(tmp_path / "checkpoints") == 4


def test_a_gate_closed_during_a_write_prevents_the_file(tmp_path: Path) -> None:
    gate = open_gate(tmp_path)

    def write(stream: IO[bytes]) -> None:
        stream.write(b"first half")
        open_gate(tmp_path)
        stream.write(b"second half")

    with pytest.raises(HeadwayError, match=TAKEN_OVER):
        write_through(tmp_path / "file", write, gate)
    assert _contents(tmp_path) == {}


def test_other_errors_are_reported_as_without_a_gate(tmp_path: Path) -> None:
    gate = open_gate(tmp_path)
    with pytest.raises(HeadwayError, match=r"cannot write .*nowhere/file"):
        write_through(tmp_path / "nowhere" / "file", lambda stream: stream.write(b""), gate)


def _failing(number: int) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    return fail


def test_a_busy_gate_is_closed_now_and_removed_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = open_gate(tmp_path)
    (before / ".nfs0001").write_bytes(b"open on this machine")
    with monkeypatch.context() as nfs:
        nfs.setattr(shutil, "rmtree", _failing(errno.EBUSY))
        after = open_gate(tmp_path)
    with pytest.raises(HeadwayError, match=TAKEN_OVER):
        write_through(tmp_path / "file", lambda stream: stream.write(b"late"), before)
    write_through(tmp_path / "file", lambda stream: stream.write(b"good"), after)
    close_gates(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_removal_is_tried_again_and_names_the_gate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_gate(tmp_path)
    pauses: list[float] = []
    monkeypatch.setattr("time.sleep", pauses.append)
    monkeypatch.setattr(shutil, "rmtree", _failing(errno.ENOTEMPTY))
    with pytest.raises(HeadwayError, match="which another process keeps writing to"):
        close_gates(tmp_path)
    assert sum(pauses) >= 0.5


def test_a_stale_handle_means_a_closed_gate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = open_gate(tmp_path)
    (tmp_path / "file").write_bytes(b"kept")
    monkeypatch.setattr(Path, "replace", _failing(errno.ESTALE))
    with pytest.raises(HeadwayError, match=TAKEN_OVER):
        write_through(tmp_path / "file", lambda stream: stream.write(b"late"), gate)
    with pytest.raises(HeadwayError, match=TAKEN_OVER):
        discard(tmp_path / "file", gate)


def _write_repeatedly(directory: Path, gate: Path) -> None:
    for number in range(10**6):
        write_through(directory / f"file-{number}", lambda stream: stream.write(b"late"), gate)


def test_a_gate_can_be_closed_during_concurrent_writes(tmp_path: Path) -> None:
    gates = [open_gate(tmp_path)]
    context = multiprocessing.get_context("fork" if threading.active_count() == 1 else "spawn")
    writers = [context.Process(target=_write_repeatedly, args=(tmp_path, gates[0])) for _ in range(2)]
    for writer in writers:
        writer.start()
    try:
        while len(list(tmp_path.glob("file-*"))) < 5:
            assert all(writer.is_alive() for writer in writers)
        open_gate(tmp_path)
        written = _contents(tmp_path)
        for writer in writers:
            writer.join(60)
    finally:
        for writer in writers:
            writer.kill()
    assert [writer.exitcode for writer in writers] == [1, 1]
    assert _contents(tmp_path) == written

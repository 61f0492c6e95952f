"""Fencing: at most one process can write to a run's folder, on any file system shared between machines.

A training process writes only through a *gate*, a subfolder of the run's folder with a unique random name: a
new file is created in the gate and renamed out of it, and a file to remove is first renamed into it. Before a
run is handed to another process, its gate is renamed (which closes it) and removed. A former writer that
resumes late can then change nothing: a rename from or to a removed folder fails. The rename checks and
writes in one atomic step, so no clock or lock shared with a disconnected machine is needed.
On NFS renaming is not enough, because another machine may still reach the folder by its file handle; so the
folder is removed too.
"""

import errno
import secrets
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

from headway.contracts import HeadwayError
from headway.store.atomic_files import make_folder, write_durably

_PREFIX = ".gate-"
_SHUT = ".shut-"
"""Prefix of a closed gate until it is removed."""
_ATTEMPTS = 100
_PAUSE_S = 0.01
_IN_USE = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT, errno.ESTALE)
"""Errors of a folder whose entries change while it is removed."""
_GONE = (errno.ENOENT, errno.ESTALE)
"""Errors of a folder that was removed; ESTALE: on NFS, reached by its file handle."""


def open_gate(directory: Path) -> Path:
    """Close all gates of a run's folder and return a new one, for one writer.

    Raises HeadwayError if a gate cannot be removed or created.
    """
    close_gates(directory)
    gate = directory / f"{_PREFIX}{secrets.token_hex(8)}"
    make_folder(gate)
    return gate


def close_gates(directory: Path) -> None:
    """Close all gates of a run's folder, so that no process can write to it.

    Raises HeadwayError if a gate cannot be renamed or removed.
    """
    for gate in directory.glob(f"{_PREFIX}*"):
        try:
            gate.rename(gate.with_name(gate.name.replace(_PREFIX, _SHUT, 1)))
        except OSError as error:
            if error.errno not in _GONE:
                raise HeadwayError(f"cannot rename {gate} ({error.strerror}): remove it by hand") from error
    # Also gates that a process closed before it was killed.
    for gate in directory.glob(f"{_SHUT}*"):
        _remove(gate)


def _remove(gate: Path) -> None:
    """Remove a closed gate. Raises HeadwayError if it stays in use."""
    for _ in range(_ATTEMPTS):
        try:
            shutil.rmtree(gate)
        except FileNotFoundError:
            if not gate.exists():
                return
        except OSError as error:
            if error.errno == errno.EBUSY:
                # A file that a process of this machine has open, on NFS: the next call removes it. It does no
                # harm, since this machine already sees the gate under its new name.
                return
            if error.errno not in _IN_USE:
                raise HeadwayError(f"cannot remove {gate} ({error.strerror}): remove it by hand") from error
        else:
            return
        time.sleep(_PAUSE_S)
    raise HeadwayError(f"cannot remove {gate}, which another process keeps writing to: end that process")


def write_through(path: Path, write: Callable[[IO[bytes]], object], gate: Path | None) -> None:
    """Write a file by `write_durably` through a gate; None: without fencing.

    Raises HeadwayError if the file cannot be written or the gate has been closed.
    """
    try:
        write_durably(path, write, temporary_folder=gate)
    except HeadwayError as error:
        _require_open(gate, error)
        raise


def discard(path: Path, gate: Path | None) -> None:
    """Remove a file, if it exists, through a gate; None: without fencing.

    Raises HeadwayError if the gate has been closed.
    """
    if gate is None:
        path.unlink(missing_ok=True)
        return
    try:
        path.replace(gate / path.name).unlink()
    except OSError as error:
        if error.errno not in _GONE:
            raise
        _require_open(gate, error)


def _require_open(gate: Path | None, error: Exception) -> None:
    if gate is not None and not _is_open(gate, error):
        raise HeadwayError(
            f"another training process has taken over {gate.parent}: this one ends without changing it"
        ) from error


def _is_open(gate: Path, error: Exception) -> bool:
    cause = error.__cause__ or error
    if isinstance(cause, OSError) and cause.errno == errno.ESTALE:
        return False
    try:
        return gate.is_dir()
    except OSError as failure:
        if failure.errno == errno.ESTALE:
            return False
        raise

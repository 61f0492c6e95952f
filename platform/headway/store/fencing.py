"""One writer at a time in a run's folder, on any file system that machines share.

A training process writes to a run's folder only through a gate: a folder inside it, of a name that was
never there before. A file is made in the gate and moved out of it, and one that goes is moved into it. Who
hands the run to another process renames the gate first, which shuts it, and removes it. From then on whoever
held it can change nothing, however late it wakes, because a file system moves nothing from or to a folder
that is gone: there is no moment between looking and writing, and no clock or lock that a cut-off machine
would have to agree about. The name alone would not do where another machine still knows the folder by its
handle (NFS); what only waits to be closed on this machine, whose names are up to date, may be left.
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
"""Instead of the prefix, until a gate is removed."""
_ATTEMPTS = 100
_PAUSE_S = 0.01
_IN_USE = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT, errno.ESTALE)
"""Of a folder in which something is just being made, moved or removed."""
_GONE = (errno.ENOENT, errno.ESTALE)
"""Of a folder that is gone; ESTALE: and was known by its handle, on NFS."""


def open_gate(directory: Path) -> Path:
    """Shut out whoever may write to a run's folder, and open it for one other.

    Raises HeadwayError if that is not possible.
    """
    shut_gates(directory)
    gate = directory / f"{_PREFIX}{secrets.token_hex(8)}"
    make_folder(gate)
    return gate


def shut_gates(directory: Path) -> None:
    """Shut out whoever may write to a run's folder. Raises HeadwayError if that is not possible."""
    for gate in directory.glob(f"{_PREFIX}*"):
        try:
            gate.rename(gate.with_name(gate.name.replace(_PREFIX, _SHUT, 1)))
        except OSError as error:
            if error.errno not in _GONE:
                raise HeadwayError(f"cannot rename {gate} ({error.strerror}): remove it") from error
    for gate in directory.glob(f"{_SHUT}*"):
        _remove(gate)


def _remove(gate: Path) -> None:
    """Remove a shut gate; what NFS keeps of it because a process of this machine has it open goes when a gate
    is shut here next."""
    for _ in range(_ATTEMPTS):
        try:
            shutil.rmtree(gate)
        except FileNotFoundError:
            if not gate.exists():
                return
        except OSError as error:
            if error.errno == errno.EBUSY:
                return
            if error.errno not in _IN_USE:
                raise HeadwayError(f"cannot remove {gate} ({error.strerror}): remove it") from error
        else:
            return
        time.sleep(_PAUSE_S)
    raise HeadwayError(f"cannot remove {gate}, which fills again and again: end what writes there")


def write_through(path: Path, write: Callable[[IO[bytes]], object], gate: Path | None) -> None:
    """`write_durably` by whoever holds the gate; no gate: by anybody. Raises HeadwayError as that does, and
    if the gate has been shut."""
    try:
        write_durably(path, write, made_in=gate)
    except HeadwayError as error:
        _require_open(gate, error)
        raise


def discard(path: Path, gate: Path | None) -> None:
    """Remove a file, by whoever holds the gate; no gate: by anybody. That it is gone already is no error.

    Raises HeadwayError if the gate has been shut.
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
            f"another training process has taken over {gate.parent}: this one ends, and changes nothing there"
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

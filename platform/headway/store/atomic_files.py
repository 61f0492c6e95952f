"""Atomic file writes: a file is complete or absent, even after a crash of the process or the machine."""

import errno
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from headway.contracts import HeadwayError

_FULL = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}
_PARTIAL = ".partial"


def write_durably(
    path: Path, write: Callable[[IO[bytes]], object], temporary_folder: Path | None = None
) -> None:
    """Write a file atomically: an older file at `path` stays until the new one is complete.

    `write` fills a temporary file, which is flushed (fsync) and renamed to `path`; then the folder is
    flushed. `temporary_folder`, on the same file system, holds the temporary file; None: the folder of
    `path`. Raises HeadwayError with one line if the file cannot be written (disk full, no permission, ...).
    """
    try:
        descriptor, name = tempfile.mkstemp(_PARTIAL, f".{path.name}-", temporary_folder or path.parent)
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                write(stream)
                stream.flush()
                os.fsync(stream.fileno())
            # mkstemp creates files that only their owner can read.
            temporary.chmod(0o644)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise _write_error(path, error) from error


def write_text(path: Path, text: str) -> None:
    """Write text to a file by `write_durably`. Raises HeadwayError if it cannot be written."""
    write_durably(path, lambda stream: stream.write(text.encode()))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object to a file by `write_durably`. Raises HeadwayError if it cannot be written."""
    write_text(path, json.dumps(content, indent=2, default=str) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object. Raises HeadwayError if the file is missing, unreadable or holds no JSON object."""
    require_regular(path)
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise HeadwayError(f"{path} cannot be read ({_reason(error)}): remove or repair it") from error
    if not isinstance(content, dict):
        raise HeadwayError(f"{path} holds no JSON object: remove or repair it")
    return content


def require_regular(path: Path) -> None:
    """Raise HeadwayError for a pipe or a device: reading it would never end."""
    if path.exists() and not path.is_file():
        raise HeadwayError(f"{path} is not a regular file: remove it")


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises HeadwayError if it cannot be created."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _write_error(path, error) from error


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to disk (fsync), so that renames and removals in it are durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_partial(folder: Path, prefix: str) -> None:
    """Remove the partly written files in `folder` whose names begin with `prefix`.

    Only the process that writes these files may call this.
    """
    for leftover in folder.glob(f".{prefix}*{_PARTIAL}"):
        leftover.unlink(missing_ok=True)


@contextmanager
def locked(path: Path, seconds: float, purpose: str) -> Iterator[None]:
    """Hold an exclusive lock among the processes of this machine, on the file `path` (created if missing).

    A lock is released when its process ends. Raises HeadwayError after waiting for `seconds`, and if the file
    cannot be written or locked.
    """
    import fcntl  # POSIX only; reading a store works without it

    try:
        stream = path.open("a")
    except OSError as error:
        raise _write_error(path, error) from error
    with stream:
        deadline = time.monotonic() + seconds
        while True:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise HeadwayError(
                        f"{path} stayed locked for {seconds:g} s while {purpose}: "
                        "end the session that holds the lock, or try again"
                    ) from None
                time.sleep(0.05)
            except OSError as error:
                raise HeadwayError(f"{path} cannot be locked ({error.strerror}): use another disk") from error
        yield


def _write_error(path: Path, error: OSError) -> HeadwayError:
    reason = _FULL.get(error.errno or 0)
    if reason is None:
        denied = isinstance(error, PermissionError) or error.errno == errno.EROFS
        fix = "check the folder's permissions" if denied else "choose another folder"
        return HeadwayError(f"cannot write {path} ({_reason(error)}): {fix}")
    return HeadwayError(f"cannot write {path}: {reason}; free some space and resume, saved data is intact")


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)

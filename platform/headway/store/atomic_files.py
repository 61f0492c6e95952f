"""Files that are either wholly there or not there at all, whatever ends the process or the machine."""

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


def write_durably(path: Path, write: Callable[[IO[bytes]], object], made_in: Path | None = None) -> None:
    """Let `write` fill a file that then takes the name `path`: a temporary name, fsync, rename, fsync of
    the folder. Whatever had that name stays until the new file is whole. `made_in`: the folder of the
    temporary name, on the same file system; None: that of `path`.

    Raises HeadwayError in one line if the file cannot be written (disk full, no permission, ...).
    """
    try:
        descriptor, name = tempfile.mkstemp(_PARTIAL, f".{path.name}-", made_in or path.parent)
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                write(stream)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise _unwritable(path, error) from error


def write_text(path: Path, text: str) -> None:
    """`write_durably` for a text; raises HeadwayError alike."""
    write_durably(path, lambda stream: stream.write(text.encode()))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """`write_durably` for a JSON object; raises HeadwayError alike."""
    write_text(path, json.dumps(content, indent=2, default=str) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file. Raises HeadwayError if it is missing or is none."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise HeadwayError(f"{path} cannot be read ({_reason(error)}): remove or repair it") from error
    if not isinstance(content, dict):
        raise HeadwayError(f"{path} holds no JSON object: remove or repair it")
    return content


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises HeadwayError if that is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from error


def sync_folder(folder: Path) -> None:
    """Make renames and removals in `folder` durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_partial(folder: Path, prefix: str) -> None:
    """Remove half-written files of names that begin with `prefix`. Only for the one writer of those."""
    for leftover in folder.glob(f".{prefix}*{_PARTIAL}"):
        leftover.unlink(missing_ok=True)


@contextmanager
def locked(path: Path, seconds: float, purpose: str) -> Iterator[None]:
    """Hold an exclusive lock on the file `path` (created if need be) among processes of this machine.

    Raises HeadwayError if another process holds it for longer than `seconds`. A dead holder's lock is free.
    """
    import fcntl  # POSIX only; reading a store works without it

    with path.open("a") as stream:
        deadline = time.monotonic() + seconds
        while True:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise HeadwayError(
                        f"{path} stayed locked for {seconds:g} s while {purpose}: "
                        "end the other session that holds it, or try again"
                    ) from None
                time.sleep(0.05)
        yield


def _unwritable(path: Path, error: OSError) -> HeadwayError:
    reason = _FULL.get(error.errno or 0)
    if reason is None:
        return HeadwayError(f"cannot write {path} ({_reason(error)}): check that the folder may be written")
    return HeadwayError(f"cannot write {path}: {reason}; free some space and resume, nothing kept is lost")


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)

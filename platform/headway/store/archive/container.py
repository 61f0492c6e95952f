"""The container of an archive: a zip with checksums, whose bytes depend on its contents only."""

import json
import shlex
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import IO, Any

from headway.contracts import HeadwayError
from headway.store.atomic_files import write_durably
from headway.store.checkpoint import NoCheckpointError

MANIFEST = "manifest.json"
_FORMAT, _VERSION = "headway archive", 1
_RUNS = "runs/"
"""Folder of the members that form a store."""
_EARLIEST = (1980, 1, 1, 0, 0, 0)
"""Time of every member: the first that zip knows."""
_STORED_ONCE = ".pt"
"""Suffix of files of which equal ones are stored once, under the first name: the seeds of a stack have the
same checkpoint."""


def write_archive(path: Path, about: Mapping[str, Any], files: Iterable[tuple[str, bytes]]) -> str:
    """Write an archive durably and return its SHA-256. Equal contents give equal bytes.

    `about`: further keys of the manifest; `files`: (name, content) of each file. Raises HeadwayError if it
    cannot be written.
    """

    def write(stream: IO[bytes]) -> None:
        sums: dict[str, str] = {}
        stored: set[str] = set()
        with zipfile.ZipFile(stream, "w") as container:
            for name, content in files:
                sums[name] = sha256(content).hexdigest()
                if not (name.endswith(_STORED_ONCE) and sums[name] in stored):
                    _add(container, name, content)
                stored.add(sums[name])
            manifest = {"format": _FORMAT, "version": _VERSION, **about, "files": sums}
            _add(container, MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())

    write_durably(path, write)
    with path.open("rb") as written:
        digest = sha256()
        while part := written.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()


def _add(container: zipfile.ZipFile, name: str, content: bytes) -> None:
    member = zipfile.ZipInfo(name, _EARLIEST)
    member.create_system, member.external_attr = 3, 0o644 << 16  # as on Unix, on every system
    container.writestr(member, content, zipfile.ZIP_DEFLATED, 6)


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Check an archive; yield the store that it holds, in a temporary folder, and its manifest.

    Raises HeadwayError if the file is missing, damaged, no archive or one of a newer format. Any HeadwayError
    of the caller names the archive instead of the temporary folder.
    """
    with tempfile.TemporaryDirectory(prefix="headway-") as folder:
        root = Path(folder, path.name)
        manifest = unpack(path, root)
        try:
            yield root, manifest
        except NoCheckpointError as error:
            again = f"headway archive {shlex.quote(manifest['study'])} --checkpoints"
            raise HeadwayError(
                f"{path} holds no checkpoint of run {error.run}: write it with `{again}`"
            ) from error
        except HeadwayError as error:
            error.args = (str(error).replace(str(root), str(path)),)
            raise


def unpack(path: Path, root: Path) -> Mapping[str, Any]:
    """Check all of an archive, write the store that it holds to `root`, and return its manifest.

    Raises HeadwayError as `unpacked` does.
    """
    try:
        with path.open("rb") as stream:
            begins_as_zip = stream.read(4) == b"PK\3\4"
    except OSError as error:
        raise HeadwayError(f"{path} cannot be read ({error.strerror})") from error
    if not begins_as_zip:
        raise HeadwayError(f"{path} is not an archive: `headway archive STUDY` writes one")
    name = "its list of files"
    try:
        with zipfile.ZipFile(path) as container:
            members = set(container.namelist())
            manifest = _manifest(path, container)
            sums: dict[str, str] = manifest["files"]
            shared = {sums[name]: name for name in members & sums.keys() if name.endswith(_STORED_ONCE)}
            if unlisted := sorted(members - {MANIFEST, *sums}):
                raise HeadwayError(f"{path} is damaged: its {MANIFEST} does not list {unlisted[0]}")
            root.mkdir(parents=True)
            for name, expected in sums.items():
                source = name if name in members else shared.get(expected)
                if source is None:
                    raise HeadwayError(f"{path} is damaged: it lacks {name}")
                content = container.read(source)
                if sha256(content).hexdigest() != expected:
                    raise HeadwayError(f"{path} is damaged: {name} does not have its checksum")
                if name.startswith(_RUNS):
                    place = root / name.removeprefix(_RUNS)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    place.write_bytes(content)
    # RuntimeError: encrypted; NotImplementedError, a subclass: compressed in another way.
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise HeadwayError(f"{path} is damaged: {name} cannot be read ({error}); get it again") from error
    except OSError as error:
        raise HeadwayError(f"{path} cannot be unpacked to {root} ({error.strerror})") from error
    return manifest


def _manifest(path: Path, container: zipfile.ZipFile) -> dict[str, Any]:
    if MANIFEST not in container.namelist():
        raise HeadwayError(f"{path} has no {MANIFEST}: it is a zip file, but not an archive of Headway")
    try:
        manifest = json.loads(container.read(MANIFEST))
    except (ValueError, RecursionError) as error:
        raise HeadwayError(f"{path} is damaged: its {MANIFEST} is not JSON") from error
    if not isinstance(manifest, dict) or manifest.get("format") != _FORMAT:
        raise HeadwayError(f"{path} is a zip file, but not an archive of Headway")
    if manifest.get("version") != _VERSION:
        raise HeadwayError(
            f"{path} has version {manifest.get('version')} of the format, and this Headway reads version "
            f"{_VERSION}: install a newer Headway"
        )
    study, files = manifest.get("study"), manifest.get("files")
    if not isinstance(files, dict) or not all(isinstance(value, str) for value in (study, *files.values())):
        raise HeadwayError(f"{path} is damaged: its {MANIFEST} lacks the study or the files")
    for name in files:
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts or "\\" in name or str(parts) != name:
            raise HeadwayError(f"{path} is damaged: its {MANIFEST} names {name!r}, which is no path in it")
    return manifest

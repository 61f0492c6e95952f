"""Archives have the bytes of their contents, and any damage to one is named in a line."""

import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import pytest

from headway.contracts import HeadwayError
from headway.store.archive.container import MANIFEST, unpack, unpacked, write_archive

FILES = [
    ("README.md", b"A study.\n" * 50),
    ("runs/bus/a/run.json", b"{}"),
    ("runs/bus/a/checkpoints/checkpoint-000004.pt", b"parameters" * 1000),
    ("runs/bus/b/run.json", b"{}"),
    ("runs/bus/b/checkpoints/checkpoint-000004.pt", b"parameters" * 1000),
]
ABOUT = {"study": "bus", "licence": "CC0-1.0"}


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / "bus.zip"
    write_archive(path, ABOUT, FILES)
    return path


def test_equal_contents_give_equal_bytes_and_their_checksum_is_told(archive: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.zip"
    told = write_archive(again, ABOUT, iter(FILES))
    assert again.read_bytes() == archive.read_bytes()
    assert told == sha256(archive.read_bytes()).hexdigest()


def test_what_comes_out_is_what_went_in(archive: Path) -> None:
    with unpacked(archive) as (root, manifest):
        found = {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        assert found == {Path(name).relative_to("runs"): whole for name, whole in FILES if "/" in name}
        assert {key: manifest[key] for key in ABOUT} == ABOUT
        assert manifest["files"] == {name: sha256(whole).hexdigest() for name, whole in FILES}
    assert not root.exists()


def test_other_programs_read_it_and_a_shared_checkpoint_is_there_once(archive: Path) -> None:
    with zipfile.ZipFile(archive) as container:
        assert container.testzip() is None
        assert container.namelist() == [*(name for name, _ in FILES[:-1]), MANIFEST]
        assert {member.date_time for member in container.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def rewritten(archive: Path, change: Callable[[dict[str, bytes]], object]) -> None:
    """Change the members of an archive, without changing its manifest."""
    with zipfile.ZipFile(archive) as container:
        members = {name: container.read(name) for name in container.namelist()}
    change(members)
    with zipfile.ZipFile(archive, "w") as container:
        for name, content in members.items():
            container.writestr(name, content)


def manifest_with(**keys: object) -> Callable[[dict[str, bytes]], object]:
    return lambda members: members.update(
        {MANIFEST: json.dumps(json.loads(members[MANIFEST]) | keys).encode()}
    )


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda members: members.pop("runs/bus/a/run.json"), "it lacks runs/bus/a/run.json"),
        (lambda members: members.pop(FILES[2][0]), f"it lacks {FILES[2][0]}"),
        (
            lambda members: members.update({"runs/bus/a/run.json": b"[]"}),
            "runs/bus/a/run.json does not have its checksum",
        ),
        (lambda members: members.update({"more.txt": b""}), "does not list more.txt"),
        (lambda members: members.pop(MANIFEST), "a zip file, but not an archive of Headway"),
        (lambda members: members.update({MANIFEST: b"{"}), "its manifest.json is not JSON"),
        (lambda members: members.update({MANIFEST: b"[]"}), "a zip file, but not an archive of Headway"),
        (manifest_with(version=2), "has version 2 of the format, and this Headway reads version 1: install"),
        (manifest_with(files=[]), "its manifest.json lacks the study or the files"),
        (manifest_with(files={FILES[2][0]: []}), "its manifest.json lacks the study or the files"),
        (manifest_with(files={"../evil": ""}), "names '../evil', which is no path in it"),
        (manifest_with(files={"/evil": ""}), "names '/evil', which is no path in it"),
    ],
)
def test_changes_are_named(
    change: Callable[[dict[str, bytes]], object], line: str, archive: Path, tmp_path: Path
) -> None:
    rewritten(archive, change)
    with pytest.raises(HeadwayError, match=r"bus\.zip") as caught:
        unpack(archive, tmp_path / "store")
    assert line in str(caught.value)
    assert not (tmp_path / "evil").exists()


def test_any_changed_byte_and_any_missing_end_is_found(archive: Path, tmp_path: Path) -> None:
    whole = archive.read_bytes()
    for place in range(0, len(whole), 97):
        archive.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        store = tmp_path / f"changed-{place}"
        with suppress(HeadwayError):  # not raised for a byte that means nothing, such as one of a time
            unpack(archive, store)
            assert (store / "bus/a/run.json").read_bytes() == b"{}"
    for length in range(0, len(whole), 97):
        archive.write_bytes(whole[:length])
        with pytest.raises(HeadwayError, match=r"is damaged|is not an archive"):
            unpack(archive, tmp_path / f"cut-{length}")


def test_other_files_are_no_archives(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("notes")
    for name, line in [("notes.txt", "is not an archive"), ("no.zip", "cannot be read"), (".", "cannot be")]:
        with pytest.raises(HeadwayError, match=line):
            unpack(tmp_path / name, tmp_path / "store")


def test_errors_on_the_store_name_the_archive(archive: Path) -> None:
    with pytest.raises(HeadwayError) as caught, unpacked(archive) as (root, _):
        raise HeadwayError(f"{root}/bus is incomplete")
    assert str(caught.value) == f"{archive}/bus is incomplete"


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    def failing() -> Iterator[tuple[str, bytes]]:
        yield FILES[0]
        raise HeadwayError("damaged")

    with pytest.raises(HeadwayError, match="damaged"):
        write_archive(tmp_path / "bus.zip", ABOUT, failing())
    assert list(tmp_path.iterdir()) == []

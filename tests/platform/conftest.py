"""Fixtures of the platform's tests."""

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, str], None]:
    """(module, its source, entry point group): puts a package of one module on the path, whose `ENTRIES` is
    registered in the group."""

    def place(module: str, source: str, group: str) -> None:
        (tmp_path / f"{module}.py").write_text(source)
        metadata = tmp_path / f"{module}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        (metadata / "entry_points.txt").write_text(f"[{group}]\nmine = {module}:ENTRIES\n")
        monkeypatch.syspath_prepend(str(tmp_path))

    return place

"""Folders with some of the installed packages, to run programs as if there were no others."""

import os
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
SOURCES = tuple(str(ROOT / folder) for folder in ("platform", "envs", "algos", "launch"))


def link_packages(folder: Path, names: Iterable[str]) -> None:
    """Link the packages of these names, and all that they require without extras, into `folder`."""
    for package in _with_requirements(names):
        for name in {file.parts[0] for file in package.files or ()} - {"..", "__pycache__"}:
            if not (link := folder / name).is_symlink():  # packages may share a folder
                link.symlink_to(str(package.locate_file(name)))


def run_with_packages(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python on `words` with Headway's sources and the packages in `folder` as the only ones."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *SOURCES])}
    command = [sys.executable, "-S", *words]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
    )


def requirements(name: str) -> list[str]:
    """Return the names of the packages that an installed one requires without extras."""
    required = map(Requirement, distribution(name).requires or ())
    return [each.name for each in required if each.marker is None or each.marker.evaluate({"extra": ""})]


def _with_requirements(names: Iterable[str]) -> list[Distribution]:
    found, pending = dict[str, Distribution](), list(names)
    while pending:
        if (name := pending.pop().lower()) not in found:
            found[name] = distribution(name)
            pending += requirements(name)
    return list(found.values())

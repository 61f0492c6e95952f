"""Helpers to inspect a section of a report."""

from collections.abc import Callable
from pathlib import Path

from headway_launch.report.parts import Section, Table
from headway_launch.report.study_data import StudyData


def section_of(root: Path, make: Callable[[StudyData], Section | None]) -> Section:
    """Return the section that `make` returns for the study `study` in the store at `root`."""
    found = make(StudyData(root, "study"))
    assert found is not None
    return found


def tables(found: Section) -> dict[str, Table]:
    """Return its tables by name."""
    return {part.name: part for part in found.body if isinstance(part, Table)}


def words(found: Section) -> str:
    """Return its text outside of tables and pictures."""
    return "\n".join(part for part in found.body if isinstance(part, str))

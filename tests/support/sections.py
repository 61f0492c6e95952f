"""Tables and text of a report's section, for tests."""

from collections.abc import Callable
from pathlib import Path

from headway_launch.report.elements import Section, Table
from headway_launch.report.study_data import StudyData


def section_of(root: Path, make: Callable[[StudyData], Section | None]) -> Section:
    """Return the section that `make` builds from the study `study` in the store at `root`."""
    found = make(StudyData(root, "study"))
    assert found is not None
    return found


def tables(found: Section) -> dict[str, Table]:
    """Return the section's tables by name."""
    return {part.name: part for part in found.body if isinstance(part, Table)}


def words(found: Section) -> str:
    """Return the section's text outside of tables and pictures."""
    return "\n".join(part for part in found.body if isinstance(part, str))

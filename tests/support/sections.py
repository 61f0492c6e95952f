"""What tests look at in a section of a report."""

from collections.abc import Callable
from pathlib import Path

from headway_launch.report.parts import Section, Table
from headway_launch.report.study_data import StudyData


def section_of(root: Path, make: Callable[[StudyData], Section | None]) -> Section:
    """The section that `make` makes of the study `study` in the store at `root`, which is to have one."""
    found = make(StudyData(root, "study"))
    assert found is not None
    return found


def tables(found: Section) -> dict[str, Table]:
    """Its tables by name."""
    return {part.name: part for part in found.body if isinstance(part, Table)}


def words(found: Section) -> str:
    """All its text outside of tables and pictures."""
    return "\n".join(part for part in found.body if isinstance(part, str))

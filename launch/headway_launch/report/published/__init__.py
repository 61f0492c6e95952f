"""Sections that set a study beside what was published of its kind: BusEnv's table, the merging study's
curves, the crossing's table."""

from headway_launch.report.parts import Section
from headway_launch.report.published.busenv import busenv_section
from headway_launch.report.published.crossing import crossing_section
from headway_launch.report.published.merging import merging_section
from headway_launch.report.study_data import StudyData


def published_sections(data: StudyData) -> list[Section]:
    """Those that a study's environments call for; most call for none."""
    made = (of_study(data) for of_study in (busenv_section, merging_section, crossing_section))
    return [section for section in made if section is not None]

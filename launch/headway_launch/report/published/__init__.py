"""Sections that compare a study with published results, which are stored with the environments."""

from headway_launch.report.elements import Section
from headway_launch.report.published.bus_published import bus_published_section
from headway_launch.report.published.intersection import intersection_section
from headway_launch.report.published.merge import merge_section
from headway_launch.report.study_data import StudyData


def published_sections(data: StudyData) -> list[Section]:
    """Return the sections for the study's environments; empty for environments without published results."""
    made = (section_of(data) for section_of in (bus_published_section, merge_section, intersection_section))
    return [section for section in made if section is not None]

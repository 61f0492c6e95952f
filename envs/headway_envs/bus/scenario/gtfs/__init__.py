"""Scenarios from a GTFS feed (gtfs.org/documentation/schedule/reference): its timetable, with passengers and
the spread of travel times by fitted numbers."""

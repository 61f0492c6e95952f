"""Import of scenarios from a GTFS feed (gtfs.org/documentation/schedule/reference).

The timetable is the feed's; passengers are synthetic and spreads of travel times fitted.
"""

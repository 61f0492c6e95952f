"""Import of scenarios from a GTFS feed (gtfs.org/documentation/schedule/reference): the feed's timetable,
with synthetic passengers and fitted spreads of travel times."""

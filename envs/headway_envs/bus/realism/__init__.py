"""Comparison of the simulator with measurements: a timetable is replayed and compared with recorded days.

calls: one row per call, simulated or recorded; trip_statistics: statistics of such a day; measured: measured
statistics of the whole city, with their sources; comparison: simulated and measured statistics; plots: plots
of days.
"""

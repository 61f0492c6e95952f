"""Comparison of the simulator with measurements: simulated days of a replay beside recorded ones.

calls: one row per call, simulated or recorded; trip_statistics: statistics of such a day; measured: measured
statistics of the whole city, with their sources; comparison: simulated beside measured statistics; plots:
plots of days.
"""

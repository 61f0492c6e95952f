"""Parameters fitted to SUNT, from which synthetic scenarios are generated.

Source of every number: SUNT, Salvador Urban Network Transportation (LabIA-UFBA), CC BY 4.0, doi
10.17632/85fdtx3kr5.1; operations of Monday 2024-08-26 and Sunday 2024-09-15, demand of March 2024 and ten
Sundays.
"""

DOI = "10.17632/85fdtx3kr5.1"
SOURCE = f"SUNT (doi {DOI}, CC BY 4.0)"
SYNTHETIC = "synthetic"
"""First word of the source of a synthetic scenario."""

STOPS_GAMMA = (2.76, 11.9)
"""Number of stops of a pattern, minus two: shape and scale of a gamma distribution."""
LINK_M_LOGNORMAL = (5.78, 0.64)
"""Length of a link, m: mean and sd of its log."""
LINK_S_LOG = (0.29, 0.683, 0.48)
"""Log of the mean time of a link, s: intercept, slope on the log of the length, sd of the residual."""
WITHIN_HOUR_SD = 0.28
"""Sd of the log of the time of a link within an hour."""
SPEED_KMH = {
    "weekday": ((5, 7, 10, 17, 22), (20.5, 14.2, 16.9, 14.5, 23.6)),
    "sunday": ((5, 7, 10, 17, 22), (21.6, 20.0, 18.2, 18.2, 23.6)),
}
"""Hours of the day and the mean speeds at them, with dwell, km/h."""
MEAN_SPEED_KMH = 17.2
"""Mean link length over mean link time, km/h."""
HOUR_SHARES = {
    "weekday": (
        *(6.9, 11.7, 10.2, 6.1, 3.8, 3.3, 4.0, 5.3, 4.5, 3.9),
        *(4.6, 6.8, 9.3, 8.1, 5.1, 2.5, 2.1, 1.4, 0.3),
    ),
    "sunday": (3.4, 6.7, 7.2, 6.4, 6.0, 6.0, 6.5, 6.4, 5.8, 5.3, 5.0, 5.3, 6.6, 7.0, 6.4, 4.5, 3.1, 1.8, 0.5),
}
"""Boardings per hour, from 05 h on, %."""
DEPARTURES = {
    "weekday": (
        *(1420, 1749, 1562, 1410, 1284, 1199, 1120, 1079, 1101, 1091),
        *(1214, 1399, 1467, 1523, 1340, 1017, 769, 564, 292),
    ),
    "sunday": (457, 620, 659, 629, 661, 652, 632, 662, 676, 653, 660, 667, 644, 636, 616, 515, 443, 348, 203),
}
"""Departures of the whole city per hour, from 05 h on."""
SUNDAY_FLEET = 430 / 1359
"""Largest number of buses under way at once on a Sunday, relative to that on a weekday."""
BOARDINGS_PER_TRIP = {"weekday": 47.0, "sunday": 28.0}
"""Median number of boardings per trip."""
BOARDING_TENTHS = (0.33, 0.09, 0.10, 0.10, 0.08, 0.08, 0.07, 0.06, 0.05, 0.04)
"""Shares of the boardings by tenth of the pattern."""
ALIGHTING_TENTHS = (0.03, 0.04, 0.05, 0.07, 0.07, 0.09, 0.10, 0.09, 0.11, 0.37)
"""Shares of the alightings by tenth of the pattern."""
ATTRACTIVENESS_SD = 1.67
"""Sd of the log of the boardings at a stop."""

ONE_WAY_SHARE = 93 / 383
"""Share of lines with a single direction, which return to their first stop."""
SUNDAY_LINES = 253 / 383
"""Share of lines that run on Sundays."""
LINE_BOARDINGS_PER_TRIP = (31.5, 0.62)
"""Weekday boardings per trip of a line: median, and sd of the log from the quartiles 20.1 and 46.5."""

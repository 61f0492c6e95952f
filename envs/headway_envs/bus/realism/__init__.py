"""Is the simulator like the city? Its days in replay, beside what was measured.

calls: what happened at every call, simulated or recorded; figures: what is measured of them; measured:
figures of the whole city, with their sources; comparing: both side by side; drawing: pictures of days.
"""

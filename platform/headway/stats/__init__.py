"""Statistics of a run, over seeds, and of comparisons between algorithms.

`headway.stats.frames` has the same statistics for pandas frames. The other modules do not import pandas.
"""

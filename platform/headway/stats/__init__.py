"""Statistics of a run, over seeds, and of comparisons between algorithms.

Importing this package imports neither scipy nor pandas. `headway.stats.frames` has the same statistics for
pandas frames.
"""

from headway.stats.curves import FEWEST_POINTS, FINAL_SHARE, auc, final_reward, value_range
from headway.stats.intervals import (
    difference_of_means,
    mean_and_half_width,
    paired_difference,
    paired_difference_over_seeds,
)
from headway.stats.samples import CONFIDENCE, Interval, MeanStd, mean_std
from headway.stats.scores import (
    Band,
    interquartile_mean,
    normalised,
    performance_profile,
    probability_of_improvement,
    sample_efficiency,
    stratified_bootstrap_interval,
)

__all__ = [
    "CONFIDENCE",
    "FEWEST_POINTS",
    "FINAL_SHARE",
    "Band",
    "Interval",
    "MeanStd",
    "auc",
    "difference_of_means",
    "final_reward",
    "interquartile_mean",
    "mean_and_half_width",
    "mean_std",
    "normalised",
    "paired_difference",
    "paired_difference_over_seeds",
    "performance_profile",
    "probability_of_improvement",
    "sample_efficiency",
    "stratified_bootstrap_interval",
    "value_range",
]

"""Plots of a study: frames of `headway.stats.frames` and `headway.store` in, matplotlib figures out.

Nothing is displayed or registered globally, so the plots work alike in a command, a report and a notebook. A
controller has the same colour in all plots that get the same `styles` from `colours`.
"""

from headway.stats.plots.costs import footprint, reward_against_cost
from headway.stats.plots.curves import FEWEST_SEEDS, by_setting, learning_curves, run_curves
from headway.stats.plots.limits import outliers
from headway.stats.plots.rules import near_rules, plot_rules, rule_styles
from headway.stats.plots.scores import (
    best_of_n,
    intervals,
    performance_profiles,
    rank_diagram,
    reward_components,
)
from headway.stats.plots.style import colours

__all__ = [
    "FEWEST_SEEDS",
    "best_of_n",
    "by_setting",
    "colours",
    "footprint",
    "intervals",
    "learning_curves",
    "near_rules",
    "outliers",
    "performance_profiles",
    "plot_rules",
    "rank_diagram",
    "reward_against_cost",
    "reward_components",
    "rule_styles",
    "run_curves",
]

"""Pictures of days with missing measurements."""

import pandas as pd
from matplotlib.figure import Figure

from headway_envs.bus.realism.plots import plot_headways_along
from headway_envs.bus.realism.trip_statistics import cv_name


def test_headways_that_were_not_measured_are_left_out() -> None:
    axes = Figure().subplots()
    some = {cv_name(0): 0.5, cv_name(4): 0.7}
    plot_headways_along(axes, {"simulated": some, "measured": pd.Series({"trip mean, min": 40.0})})
    (line,) = axes.get_lines()
    assert line.get_label() == "simulated"
    assert list(line.get_xdata()) == [1, 5]
    assert list(line.get_ydata()) == [0.5, 0.7]

"""Finite values pass the NaN check, however large, and so do rows of agents not alive."""

from dataclasses import replace

import numpy as np

from headway.contracts import Discrete, EnvSpec, Observations, StepResult
from headway.rollout.nan_check import check_finite

SPEC = EnvSpec("wide", ("a", "b"), 3, Discrete(2), state_size=2)


def test_numbers_whose_squares_overflow_are_finite() -> None:
    huge = np.float32(np.finfo(np.float32).max)
    observed = Observations(np.full((3, 2, 3), huge), np.full((3, 2), huge), np.ones((3, 2), np.bool_))
    none = np.zeros((3, 2), np.bool_)
    outcome = StepResult(
        np.full((3, 2), huge), none, none, none, np.zeros(3, np.bool_),
        observed.observations, observed.states, np.zeros((3, 0)),
    )  # fmt: skip
    check_finite(SPEC, outcome, observed, 1)
    check_finite(SPEC, None, replace(observed, alive=none), 0)

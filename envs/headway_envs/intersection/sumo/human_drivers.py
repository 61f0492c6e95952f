"""Human drivers with noise: the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000,
arXiv:cond-mat/0002177) with the parameters and the noise of Flow's controller."""

import numpy as np

from headway_envs.intersection.config import STEP_S
from headway_envs.intersection.layout import Floats

DESIRED_SPEED, HEADWAY_S, ACCELERATION, BRAKING, EXPONENT, GAP_M = 30.0, 1.0, 1.0, 1.5, 4, 2.0


def acceleration(speed: Floats, lead_speed: Floats, gap: Floats) -> Floats:
    """Return the IDM accelerations (V,) of vehicles, m/s^2; s is the gap to the leader, m (inf: no leader).

    a (1 - (v / v0)^4 - (s* / s)^2) with s* = s0 + max(0, v T + v (v - v_lead) / (2 sqrt(a b))).
    """
    closing = speed * (speed - lead_speed) / (2 * np.sqrt(ACCELERATION * BRAKING))
    desired_gap = GAP_M + np.maximum(0.0, speed * HEADWAY_S + closing)
    free = 1 - (speed / DESIRED_SPEED) ** EXPONENT
    return np.asarray(ACCELERATION * (free - (desired_gap / np.maximum(gap, 1e-3)) ** 2))


def next_speeds(
    speed: Floats, lead_speed: Floats, gap: Floats, noise: float, draw: np.random.Generator
) -> Floats:
    """Return the speeds (V,), m/s, one step later.

    Gaussian noise with standard deviation `noise` sqrt(STEP_S) is added to the accelerations.
    """
    accelerations = acceleration(speed, lead_speed, gap)
    accelerations += np.sqrt(STEP_S) * noise * draw.standard_normal(len(speed))
    return np.maximum(speed + accelerations * STEP_S, 0.0)

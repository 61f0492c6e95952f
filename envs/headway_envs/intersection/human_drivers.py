"""Human drivers with noise: the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000,
arXiv:cond-mat/0002177) with the parameters and the noise of Flow's controller."""

import numpy as np

from headway_envs.intersection.config import STEP_S
from headway_envs.intersection.layout import Floats

WISHED, HEADWAY_S, ACCELERATION, BRAKING, EXPONENT, GAP_M = 30.0, 1.0, 1.0, 1.5, 4, 2.0


def acceleration(speed: Floats, lead_speed: Floats, gap: Floats) -> Floats:
    """a (1 - (v / v0)^4 - (s* / s)^2), s* = s0 + max(0, v T + v (v - v_lead) / (2 sqrt(a b))), m/s^2.

    Of vehicles (V,) whose leaders are `gap` m ahead; infinite where there is none.
    """
    closing = speed * (speed - lead_speed) / (2 * np.sqrt(ACCELERATION * BRAKING))
    wished_gap = GAP_M + np.maximum(0.0, speed * HEADWAY_S + closing)
    free = 1 - (speed / WISHED) ** EXPONENT
    return np.asarray(ACCELERATION * (free - (wished_gap / np.maximum(gap, 1e-3)) ** 2))


def next_speeds(
    speed: Floats, lead_speed: Floats, gap: Floats, noise: float, draw: np.random.Generator
) -> Floats:
    """Speeds one step on, (V,), with Gaussian noise of `noise` x sqrt(step) on the acceleration."""
    wished = acceleration(speed, lead_speed, gap)
    wished += np.sqrt(STEP_S) * noise * draw.standard_normal(len(speed))
    return np.maximum(speed + wished * STEP_S, 0.0)

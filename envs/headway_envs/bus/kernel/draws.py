"""Keyed random numbers: their purposes and distributions.

Each number depends only on the day's key, its purpose and two indices, so that two controllers on the same
day meet the same passengers, travel times and incidents.
"""

import math

import numpy as np

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.keyed_random import uniform

DAY, EVENING, NETWORK, TRIP, LINK, INCIDENT, INCIDENT_SIZE, DISPATCH = 1, 2, 3, 4, 5, 6, 7, 8
"""Purposes of the draws; part of each number's key."""
ARRIVAL, PATIENCE, DEMAND_DAY, DEMAND_HOUR, ALIGHTING, BREAKDOWN = 9, 10, 11, 12, 13, 14
"""Further purposes."""
PATIENCE_LEFT, HAZARD_LEFT = 15, 16
"""Purposes of `future.redraw`."""
COMPLIANCE = 17
"""Whether the driver of a bus complies: one draw per bus and day."""


@compiled
def exponential(key: np.uint64, purpose: int, first: int, second: int) -> float:
    """Draw from the exponential distribution with mean 1."""
    return -math.log(uniform(key, purpose, first, second))


@compiled
def normal(key: np.uint64, purpose: int, first: int, second: int) -> float:
    """Draw a standard normal number, by Acklam's rational approximation of the inverse distribution function
    (relative error below 1.2e-9)."""
    u = uniform(key, purpose, first, second)
    if 0.02425 <= u <= 0.97575:
        q = u - 0.5
        r = q * q
        top = -3.969683028665376e01 * r + 2.209460984245205e02
        top = (top * r - 2.759285104469687e02) * r + 1.383577518672690e02
        top = (top * r - 3.066479806614716e01) * r + 2.506628277459239e00
        low = -5.447609879822406e01 * r + 1.615858368580409e02
        low = (low * r - 1.556989798598866e02) * r + 6.680131188771972e01
        low = (low * r - 1.328068155288572e01) * r + 1.0
        return q * top / low
    tail = u if u < 0.5 else 1.0 - u
    q = math.sqrt(-2.0 * math.log(tail))
    top = -7.784894002430293e-03 * q - 3.223964580411365e-01
    top = (top * q - 2.400758277161838e00) * q - 2.549732539343734e00
    top = (top * q + 4.374664141464968e00) * q + 2.938163982698783e00
    low = 7.784695709041462e-03 * q + 3.224671290700398e-01
    low = ((low * q + 2.445134137142996e00) * q + 3.754408661907416e00) * q + 1.0
    return top / low if u < 0.5 else -top / low


@compiled
def unit_lognormal(z: float, sd: float) -> float:
    """Return a lognormal factor of mean 1 for a standard normal `z`; `sd` is that of its log."""
    return math.exp(sd * z - 0.5 * sd * sd)


@compiled
def unit_gamma(z: float, sd: float) -> float:
    """Return a gamma factor of mean 1 and standard deviation `sd`, at most about 0.5, for a standard normal
    `z`, by the Wilson-Hilferty transformation."""
    if sd <= 0.0:
        return 1.0
    ninth = sd * sd / 9.0
    root = 1.0 - ninth + z * math.sqrt(ninth)
    return max(root, 0.0) ** 3


@compiled
def binomial(u: float, trials: int, probability: float) -> int:
    """Return a binomial number by inversion of the uniform number `u`. Monotone in `u`; takes about trials x
    probability steps."""
    if probability <= 0.0 or trials == 0:
        return 0
    if probability >= 1.0:
        return trials
    if probability > 0.5:
        return trials - binomial_low(1.0 - u, trials, 1.0 - probability)
    return binomial_low(u, trials, probability)


@compiled
def binomial_low(u: float, trials: int, probability: float) -> int:
    """Return a binomial number like `binomial`, for a probability above 0 and at most 1/2."""
    odds = probability / (1.0 - probability)
    mass = math.exp(trials * math.log1p(-probability))
    count = 0
    while u > mass and count < trials:
        u -= mass
        count += 1
        mass *= odds * (trials - count + 1) / count
    return count

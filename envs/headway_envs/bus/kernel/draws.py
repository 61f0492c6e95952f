"""What is drawn, and the distributions it is drawn from: two controllers that run the same day meet the same
passengers, travel times and incidents."""

import math

import numpy as np

from headway_envs.bus.kernel.compiled import compiled
from headway_envs.keyed_random import uniform

DAY, EVENING, NETWORK, TRIP, LINK, INCIDENT, INCIDENT_SIZE, DISPATCH = 1, 2, 3, 4, 5, 6, 7, 8
ARRIVAL, PATIENCE, DEMAND_DAY, DEMAND_HOUR, ALIGHTING, BREAKDOWN = 9, 10, 11, 12, 13, 14
"""Purposes."""


@compiled
def exponential(key: np.uint64, purpose: int, first: int, second: int) -> float:
    """Exponential of mean 1."""
    return -math.log(uniform(key, purpose, first, second))


@compiled
def normal(key: np.uint64, purpose: int, first: int, second: int) -> float:
    """Standard normal, by Acklam's rational approximation of the inverse distribution function (relative
    error below 1.2e-9)."""
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
    """Lognormal factor of mean 1 from a standard normal z; `sd` is the log's."""
    return math.exp(sd * z - 0.5 * sd * sd)


@compiled
def unit_gamma(z: float, sd: float) -> float:
    """Gamma factor of mean 1 and standard deviation `sd` (below about 0.5) from a standard normal z, by the
    Wilson-Hilferty cube."""
    if sd <= 0.0:
        return 1.0
    ninth = sd * sd / 9.0
    root = 1.0 - ninth + z * math.sqrt(ninth)
    return max(root, 0.0) ** 3


@compiled
def binomial(u: float, trials: int, chance: float) -> int:
    """Binomial by inversion of the uniform u: monotone in u, about trials x chance steps."""
    if chance <= 0.0 or trials == 0:
        return 0
    if chance >= 1.0:
        return trials
    if chance > 0.5:
        return trials - binomial_low(1.0 - u, trials, 1.0 - chance)
    return binomial_low(u, trials, chance)


@compiled
def binomial_low(u: float, trials: int, chance: float) -> int:
    """As `binomial`, for a chance between 0 and 1/2."""
    odds = chance / (1.0 - chance)
    mass = math.exp(trials * math.log1p(-chance))
    count = 0
    while u > mass and count < trials:
        u -= mass
        count += 1
        mass *= odds * (trials - count + 1) / count
    return count

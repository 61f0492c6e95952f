"""Keyed random numbers: each one is a function of the episode's key, a purpose and two indices.

No draw depends on how many were made before it, so two controllers that play the same episode meet the same
random events. The mixing function is the finaliser of SplitMix64 (Steele, Lea and Flood 2014, "Fast
splittable pseudorandom number generators").
"""

from pathlib import Path

import numpy as np

from headway_envs.numba_setup import compiled, drop_stale_cache

drop_stale_cache(Path(__file__).parent)

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@compiled
def mix(value: np.uint64) -> np.uint64:
    """Return SplitMix64's finaliser of `value` + the golden gamma."""
    value = value + _GOLDEN
    value = (value ^ (value >> _S30)) * _FIRST
    value = (value ^ (value >> _S27)) * _SECOND
    return value ^ (value >> _S31)


@compiled
def episode_key(seed: np.uint64, episode: int) -> np.uint64:
    """Return the key of one episode of one copy, from the copy's seed and the episode's index."""
    return mix(mix(seed) ^ np.uint64(episode))


@compiled
def uniform(key: np.uint64, purpose: int, first: int, second: int) -> float:
    """Return a uniform number on the open interval (0, 1)."""
    value = mix(key ^ (np.uint64(purpose) << np.uint64(56)) ^ np.uint64(first))
    value = mix(value ^ np.uint64(second))
    return (np.float64(value >> _S11) + 0.5) * (1.0 / 9007199254740992.0)

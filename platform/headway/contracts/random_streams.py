"""Random streams: every draw comes from a stream named by (seed, purpose, indices), never a global generator.

A draw therefore depends neither on the number of workers, nor on other seeds trained at the same time, nor on
a restart.
"""

import zlib

import numpy as np
from numpy.typing import NDArray


def _entropy(seed: int, purpose: str, indices: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence((seed, zlib.crc32(purpose.encode()), *indices))


def generator(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """Return the random generator of (seed, purpose, indices), statistically independent of all others.

    Indices name a global copy, an iteration and so on. Seed and indices must be at least 0. Give a purpose
    the same number of indices everywhere: a trailing index 0 names the same stream as no index, since numpy
    pads entropy with zeros to four 32-bit words.
    """
    return np.random.Generator(np.random.Philox(_entropy(seed, purpose, indices)))


def child_seeds(seed: int, purpose: str, first: int, count: int) -> NDArray[np.uint64]:
    """Return the seeds (count,) of copies first to first + count - 1.

    Each depends only on (`seed`, `purpose`, index of the copy), not on `count`.
    """
    seeds = [
        _entropy(seed, purpose, (index,)).generate_state(1, np.uint64)[0]
        for index in range(first, first + count)
    ]
    return np.array(seeds, dtype=np.uint64)

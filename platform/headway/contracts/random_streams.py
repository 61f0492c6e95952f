"""Random streams: every draw comes from (seed, purpose, indices), never from a global generator.

So neither the number of workers, nor the seeds trained beside a run, nor a restart changes a draw.
"""

import zlib

import numpy as np
from numpy.typing import NDArray


def _entropy(seed: int, purpose: str, indices: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence((seed, zlib.crc32(purpose.encode()), *indices))


def generator(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """A generator for `purpose` and `indices` (a global copy index, an iteration, ...), independent of those
    for others.

    Seeds and indices are integers of at least 0. A zero at the end of the indices makes no other stream
    (numpy fills entropy up with zeros to four words of 32 bits): always give a purpose as many indices.
    """
    return np.random.Generator(np.random.Philox(_entropy(seed, purpose, indices)))


def child_seeds(seed: int, purpose: str, first: int, count: int) -> NDArray[np.uint64]:
    """Seeds of the copies first to first + count - 1: shape (count,). Copy i's depends on i alone."""
    seeds = [
        _entropy(seed, purpose, (index,)).generate_state(1, np.uint64)[0]
        for index in range(first, first + count)
    ]
    return np.array(seeds, dtype=np.uint64)

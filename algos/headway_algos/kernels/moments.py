"""Means and squared deviations of the rows of a stack."""

import numpy as np
from numpy.typing import NDArray

from headway_algos.kernels.compiled import Floats, compiled


@compiled
def write_moments(
    rows: Floats, chosen: NDArray[np.bool_], means: NDArray[np.float64], squares: NDArray[np.float64]
) -> None:
    """Write means and sums of squared deviations (P, D) of the rows (P, B, D) where `chosen` (P, B) is true.

    Both are 0 where there are none.
    """
    size = rows.shape[2]
    for p in range(len(rows)):
        mean, square, count = means[p], squares[p], 0
        mean[:] = 0
        square[:] = 0
        for b in range(len(rows[p])):
            if chosen[p, b]:
                count += 1
                for d in range(size):
                    mean[d] += rows[p, b, d]
        if count == 0:
            continue
        for d in range(size):
            mean[d] /= count
        # In a second pass: the difference of sums of squares would cancel digits.
        for b in range(len(rows[p])):
            if chosen[p, b]:
                for d in range(size):
                    deviation = rows[p, b, d] - mean[d]
                    square[d] += deviation * deviation

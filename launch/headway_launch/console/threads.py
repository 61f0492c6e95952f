"""Thread limits: parallel processes fill the machine, so each uses one thread."""

import os

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Environment variables that limit numerical libraries to one thread."""


def limit_threads() -> None:
    """Limit this process's numerical libraries to one thread. Must run before any of them is imported."""
    os.environ.update(ONE_THREAD)

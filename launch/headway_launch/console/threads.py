"""Processes fill the machine, so each keeps to one thread."""

import os

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Environment variables of a process whose numerical libraries keep to one thread."""


def limit_threads() -> None:
    """One thread a process for numerical libraries, before any of them is imported."""
    os.environ.update(ONE_THREAD)

"""Processes fill the machine, so each keeps to one thread."""

import os


def limit_threads() -> None:
    """One thread a process for numerical libraries, before any of them is imported."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = "1"

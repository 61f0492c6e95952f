"""Thread limits: parallel processes fill the machine, so each uses one thread."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Environment variables that limit numerical libraries to one thread."""


def limit_threads() -> None:
    """Limit this process's numerical libraries to one thread. Must run before any of them is imported."""
    os.environ.update(ONE_THREAD)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit the processes that are started inside to one thread each, and restore the environment."""
    # Numba, once it is imported, refuses another number of threads than those it has started.
    names = [name for name in ONE_THREAD if not (name.startswith("NUMBA") and "numba" in sys.modules)]
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value

"""Compilation of the kernels with numba, and removal of stale compiled code."""

import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

from headway.contracts import numba_setup
from headway.contracts.numba_setup import compiled_with

P = ParamSpec("P")
R = TypeVar("R")

SHARED = ("numba_setup.py", "keyed_random.py")
"""Source files of this folder that every kernel is compiled with."""


def drop_stale_cache(folder: Path) -> None:
    """Remove cached machine code compiled from an older state of the kernel in `folder`.

    Numba checks only the file of the function that is called, not those of the functions it calls in turn, so
    after a change elsewhere it would keep using the old machine code.
    """
    state = 0
    shared = [Path(numba_setup.__file__), *(Path(__file__).with_name(name) for name in SHARED)]
    for source in [*sorted(folder.glob("*.py")), *shared]:
        state = zlib.crc32(source.read_bytes(), state)
    cache = folder / "__pycache__"
    stamp = cache / "kernel.stamp"
    try:
        if stamp.is_file() and stamp.read_text() == f"{state}":
            return
        for compiled_file in cache.glob("*.nb?"):
            compiled_file.unlink(missing_ok=True)
        cache.mkdir(exist_ok=True)
        written = cache / f"kernel.stamp.{os.getpid()}"
        written.write_text(f"{state}")
        written.replace(stamp)
    except OSError:
        return  # In a read-only installation numba caches elsewhere, and sources do not change.


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel function to be inlined into its callers, without array allocation (see
    `headway.contracts.numba_setup.compiled_with`).

    Without numba's reference counting of the many arrays passed through a kernel it runs several times as
    fast; the price is that the function cannot allocate arrays.
    """
    return compiled_with(function, _nrt=False, forceinline=True)


def compiled_apart(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel function without inlining and without array allocation, for functions called from many
    places, where inlined copies would bloat the code."""
    return compiled_with(function, _nrt=False)


def compiled_allocating(function: Callable[P, R]) -> Callable[P, R]:
    """Compile one of the few kernel functions that allocate arrays, with numba's reference counting."""
    return compiled_with(function)

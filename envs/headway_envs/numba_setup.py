"""How kernels are compiled and when what was compiled is no longer theirs."""

import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

from headway.contracts import numba_setup
from headway.contracts.numba_setup import compiled_with

P = ParamSpec("P")
R = TypeVar("R")

SHARED = ("numba_setup.py", "keyed_draws.py")
"""Sources in this folder that every kernel is compiled with."""


def drop_stale_cache(folder: Path) -> None:
    """Remove compiled code of an older state of the kernel in `folder`.

    Numba looks only at the file of the function that is called, not at those it calls in turn, so after a
    change elsewhere it would go on with the old machine code."""
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
        return  # A read-only installation: numba keeps its cache elsewhere, and sources do not change.


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """See `headway.contracts.numba_setup.compiled_with`.

    It cannot allocate arrays: without numba's reference counting of the many arrays that travel through a
    kernel it runs several times as fast."""
    return compiled_with(function, _nrt=False, forceinline=True)


def compiled_apart(function: Callable[P, R]) -> Callable[P, R]:
    """As `compiled`, for functions called from many places, which would be long if they stood in each."""
    return compiled_with(function, _nrt=False)


def compiled_allocating(function: Callable[P, R]) -> Callable[P, R]:
    """As `compiled`, for the rare functions that allocate arrays."""
    return compiled_with(function)

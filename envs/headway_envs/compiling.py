"""How kernels are compiled and when what was compiled is no longer theirs."""

import os
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast


@contextmanager
def _out_of_reach(*names: str) -> Iterator[None]:
    """Modules that were not imported yet cannot be, meanwhile."""
    hidden: dict[str, Any] = {name: None for name in names if name not in sys.modules}
    sys.modules.update(hidden)
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


# When it is loaded numba tries whether there is scipy's linear algebra, which no kernel here calls: 16 MB of
# every worker, and half the time that it takes to load its kernels. Other compiled code that calls `dot` or
# `numpy.linalg` finds scipy later. But numba decides here for good (`_HAVE_BLAS`), for this process, that
# compiled `numpy.convolve` and `correlate` do without BLAS: more slowly, and with other last bits.
with _out_of_reach("scipy", "scipy.linalg.cython_blas"):
    import numba

    import_module("numba.np.arraymath")

P = ParamSpec("P")
R = TypeVar("R")

SHARED = ("compiling.py", "keyed_draws.py")
"""Sources in this folder that every kernel is compiled with."""


def drop_stale_cache(folder: Path) -> None:
    """Remove compiled code of an older state of the kernel in `folder`.

    Numba looks only at the file of the function that is called, not at those it calls in turn, so after a
    change elsewhere it would go on with the old machine code."""
    state = 0
    for source in [*sorted(folder.glob("*.py")), *(Path(__file__).with_name(name) for name in SHARED)]:
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
    """`function` compiled by numba at its first call and kept in the cache beside its file.

    It cannot allocate arrays: without numba's reference counting of the many arrays that travel through a
    kernel it runs several times as fast. Floating-point division follows IEEE rules, as in numpy."""
    jit = numba.njit(cache=True, nogil=True, error_model="numpy", _nrt=False, forceinline=True)
    return cast("Callable[P, R]", jit(function))


def compiled_apart(function: Callable[P, R]) -> Callable[P, R]:
    """As `compiled`, for functions called from many places, which would be long if they stood in each."""
    jit = numba.njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
    return cast("Callable[P, R]", jit(function))


def compiled_allocating(function: Callable[P, R]) -> Callable[P, R]:
    """As `compiled`, for the rare functions that allocate arrays."""
    jit = numba.njit(cache=True, nogil=True, error_model="numpy")
    return cast("Callable[P, R]", jit(function))

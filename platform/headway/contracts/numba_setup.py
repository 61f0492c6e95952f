"""How numba comes in, and functions compiled by it are kept, for environments and algorithms alike."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, ParamSpec, TypeVar, cast

P = ParamSpec("P")
R = TypeVar("R")


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


def compiled_with(function: Callable[P, R], **options: object) -> Callable[P, R]:
    """`function` compiled by numba, without the interpreter's lock, at its first call, and kept in the cache
    beside its file. Floating-point division follows IEEE rules, as in numpy.

    Where neither that folder nor numba's own (`NUMBA_CACHE_DIR`) can be written to, nothing is kept: each
    process compiles anew."""
    options = {"nogil": True, "error_model": "numpy", **options}
    try:
        jit = numba.njit(cache=True, **options)(function)
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        jit = numba.njit(**options)(function)
    return cast("Callable[P, R]", jit)

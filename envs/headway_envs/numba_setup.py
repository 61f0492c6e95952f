"""Compilation of the kernels with numba, and removal of stale compiled code."""

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
    """Remove cached machine code compiled from an older state of the kernel in `folder`, or of `SHARED`."""
    numba_setup.drop_stale_cache(folder, [Path(__file__).with_name(name) for name in SHARED])


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

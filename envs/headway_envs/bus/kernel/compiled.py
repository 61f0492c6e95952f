"""How every kernel function is compiled."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """`function` compiled by numba at its first call and kept in the cache beside its file.

    Floating-point division follows IEEE rules, as in numpy, instead of raising."""
    jit = numba.njit(cache=True, nogil=True, error_model="numpy")
    return cast("Callable[P, R]", jit(function))

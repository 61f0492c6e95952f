"""How the kernels of this package are compiled."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from headway.contracts.numba_setup import compiled_with, drop_stale_cache

P = ParamSpec("P")
R = TypeVar("R")
Floats = NDArray[Any]
"""Array of floating-point numbers."""
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)

drop_stale_cache(Path(__file__).parent)


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile without memory allocation; sums may be reordered and fused, NaN and infinities are kept."""
    return compiled_with(function, _nrt=False, fastmath={"contract", "reassoc", "nsz"})

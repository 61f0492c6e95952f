"""How numba is imported, and how its compiled functions are cached, in every package of the project."""

import os
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

P = ParamSpec("P")
R = TypeVar("R")


@contextmanager
def _import_blocked(*names: str) -> Iterator[None]:
    """Make modules that are not imported yet impossible to import inside the `with` block."""
    hidden: dict[str, Any] = {name: None for name in names if name not in sys.modules}
    sys.modules.update(hidden)
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


# Importing numba probes scipy's linear algebra, which no kernel here calls: 16 MB per worker and half its
# import time. Compiled code that calls `dot` or `numpy.linalg` finds scipy later. The price: numba fixes
# `_HAVE_BLAS` here for the whole process, so compiled `numpy.convolve` and `correlate` run without BLAS: more
# slowly, and with other last bits.
with _import_blocked("scipy", "scipy.linalg.cython_blas"):
    import numba

    import_module("numba.np.arraymath")


def compiled_with(function: Callable[P, R], **options: object) -> Callable[P, R]:
    """Compile `function` with numba at its first call, without the GIL, cached on disk beside its file.

    Floating-point division follows IEEE rules, as in numpy. If neither that folder nor numba's own
    (`NUMBA_CACHE_DIR`) is writable, there is no cache and every process compiles anew.
    """
    options = {"nogil": True, "error_model": "numpy", **options}
    try:
        jit = numba.njit(cache=True, **options)(function)
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        jit = numba.njit(**options)(function)
    return cast("Callable[P, R]", jit)


def drop_stale_cache(folder: Path, shared: Sequence[Path] = ()) -> None:
    """Remove cached machine code compiled from an older state of the sources in `folder`, or of `shared`.

    Numba checks only the file of the function that is called, not those of the functions it calls in turn, so
    after a change elsewhere it would keep using the old machine code.
    """
    state = 0
    for source in [*sorted(folder.glob("*.py")), Path(__file__), *shared]:
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

"""How numba is imported, and how its compiled functions are cached, in every package of the project."""

import fcntl
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
# `_HAVE_BLAS` here for the whole process, so compiled `numpy.convolve` and `correlate` run without BLAS: they
# are slower, and round differently in the last bits.
with _import_blocked("scipy", "scipy.linalg.cython_blas"):
    import numba

    import_module("numba.np.arraymath")
    from numba.core.caching import FunctionCache


class _LockedCache(FunctionCache):  # type: ignore[misc]  # numba has no type stubs
    """Numba's cache on disk, written by one process at a time.

    Numba numbers its files without a lock: two processes that compile one function for different types would
    write the same file, and later processes load the machine code of the wrong types.
    """

    def _save_overload(self, sig: object, data: object) -> None:
        self._impl.locator.ensure_cache_path()
        with Path(self._impl.locator.get_cache_path(), "kernel.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            super()._save_overload(sig, data)


def compiled_with(function: Callable[P, R], **options: object) -> Callable[P, R]:
    """Compile `function` with numba at its first call, without the GIL, cached on disk beside its file.

    Floating-point division follows IEEE rules, as in numpy. If neither that folder nor numba's own
    (`NUMBA_CACHE_DIR`) is writable, there is no cache and every process compiles anew.
    """
    options = {"nogil": True, "error_model": "numpy", **options}
    jit = numba.njit(**options)(function)
    try:
        jit._cache = _LockedCache(function)
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
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

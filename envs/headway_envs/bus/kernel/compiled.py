"""Decorators that compile the functions of this kernel. Importing it removes stale compiled code."""

from pathlib import Path

from headway_envs.numba_setup import (
    compiled,
    compiled_allocating,
    compiled_apart,
    drop_stale_cache,
)

drop_stale_cache(Path(__file__).parent)

__all__ = ["compiled", "compiled_allocating", "compiled_apart"]

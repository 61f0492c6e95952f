"""Worker processes that begin warm: forked from a server that has loaded a kernel.

The first kernel takes each process 0.4 s, whatever it computes: numba registers its types and functions.
"""

import os
from collections.abc import Sequence
from multiprocessing import forkserver
from pathlib import Path

import pytest

_MODULES = ("rehearsal", "loaded_kernels")


def warm_workers(patch: pytest.MonkeyPatch) -> None:
    """Let the server of worker processes, which starts with the first of them, import `_MODULES` too."""
    preload = forkserver.set_forkserver_preload

    def more(modules: Sequence[str]) -> None:
        preload([*modules, *_MODULES])

    folders = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, folders)))
    patch.setattr(forkserver, "set_forkserver_preload", more)

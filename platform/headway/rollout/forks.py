"""Protection of worker processes against environments that fork, and against importing the main module."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


def end_if_forked(process_id: int) -> None:
    """End this process if its id is not `process_id`, which means that an environment forked it off.

    It would otherwise continue as a second worker, with the same pipe and the same shared memory.
    """
    if os.getpid() != process_id:
        os._exit(1)


@contextmanager
def without_main_module() -> Iterator[None]:
    """Start processes that do not import the main module, which may import torch or train on import."""
    # Multiprocessing finds the main module by these two attributes.
    main = sys.modules["__main__"]
    hidden: dict[str, Any] = {
        name: vars(main)[name] for name in ("__spec__", "__file__") if name in vars(main)
    }
    vars(main).update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        vars(main).update(hidden)

"""Compilation of the kernels, once, before any process starts.

`python -m headway_launch.runner.warm_up` (`make setup`) compiles those of all environments and algorithms.
"""

import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from itertools import chain
from multiprocessing import get_context
from threading import Event, Thread
from typing import TYPE_CHECKING

from headway.registry import algo_entries, env_entries
from headway_launch.console.output import print_line
from headway_launch.console.progress import duration

if TYPE_CHECKING:
    from headway.contracts.entries import EnvEntry
    from headway_launch.experiments.experiment import Experiment

_EVERY_S = 30.0
"""Seconds between two lines about a compilation that goes on."""


def compile_kernels(env: "EnvEntry") -> None:
    """Compile an environment's kernels, by calling `warm` in its preloaded modules that define it.

    Training processes and workers then load them from the cache instead of all compiling at the same time.
    """
    _warm(env.preload)


def compile_kernels_of(experiments: "Iterable[Experiment]") -> None:
    """Compile the kernels of the environments and algorithms of `experiments`."""
    entries = [(experiment.env.preload, experiment.algo.kernels) for experiment in experiments]
    _warm(name for of_env, of_algo in entries for name in (*of_env, *of_algo))


def compile_all_kernels() -> None:
    """Compile the kernels of all registered environments and algorithms, in one process per core."""
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        list(pool.map(_warm_module, kernel_modules()))


def kernel_modules() -> list[str]:
    """Return the modules, by name, of all environments and algorithms that may define `warm`."""
    of_envs = (entry.preload for entry in env_entries().values())
    of_algos = (entry.kernels for entry in algo_entries().values())
    return list(dict.fromkeys(chain.from_iterable((*of_envs, *of_algos))))


def _warm(names: Iterable[str]) -> None:
    modules = [module for name in dict.fromkeys(names) if hasattr(module := import_module(name), "warm")]
    for place, module in enumerate(modules, start=1):
        with _compilation_shown(f"{module.__name__} ({place} of {len(modules)})"):
            module.warm()


def _warm_module(name: str) -> None:
    module = import_module(name)
    if hasattr(module, "warm"):
        module.warm()


@contextmanager
def _compilation_shown(kernels: str) -> Iterator[None]:
    """Print a line about `kernels` when numba begins to compile, and others while it does; loading from its
    cache is not reported."""
    if "numba" not in sys.modules:
        yield
        return
    from numba.core import event

    over = Event()

    class FirstCompilation(event.Listener):  # type: ignore[misc]  # numba has no type stubs
        printed = False

        def on_start(self, event: object) -> None:
            if not self.printed:
                print_line(f"compiling the kernels of {kernels}, once (a few minutes)")
                Thread(target=_print_elapsed, args=(kernels, over), daemon=True).start()
            self.printed = True

        def on_end(self, event: object) -> None:
            """Do nothing; the listener must define this method."""

    try:
        with event.install_listener("numba:compile", FirstCompilation()):
            yield
    finally:
        over.set()


def _print_elapsed(kernels: str, over: Event) -> None:
    """Print the time since the call at intervals, until `over` is set."""
    began = time.monotonic()
    while not over.wait(_EVERY_S):
        print_line(f"still compiling the kernels of {kernels}, for {duration(time.monotonic() - began)}")


if __name__ == "__main__":
    compile_all_kernels()

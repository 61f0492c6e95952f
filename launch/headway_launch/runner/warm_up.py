"""Compilation of the kernels, once, before any process starts."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING

from headway_launch.console.output import print_line

if TYPE_CHECKING:
    from headway.contracts.entries import EnvEntry
    from headway_launch.experiments.compose import Experiment

_LINE = "compiling kernels, once"


def compile_kernels(env: "EnvEntry") -> None:
    """Call `warm` in the preloaded modules of an environment that define it, so that training processes and
    workers load the kernels from the cache instead of compiling them all at once."""
    _warm(env.preload)


def compile_kernels_of(experiments: "Iterable[Experiment]") -> None:
    """Compile the kernels of the environments and algorithms of `experiments`."""
    entries = [(experiment.env.preload, experiment.algo.kernels) for experiment in experiments]
    _warm(dict.fromkeys(name for of_env, of_algo in entries for name in (*of_env, *of_algo)))


def _warm(names: Iterable[str]) -> None:
    modules = [import_module(name) for name in names]
    for module in modules:
        if hasattr(module, "warm"):
            with _compilation_shown():
                module.warm()


@contextmanager
def _compilation_shown() -> Iterator[None]:
    """Print a line when numba begins to compile; loading from its cache is not reported."""
    if "numba" not in sys.modules:
        yield
        return
    from numba.core import event

    class FirstCompilation(event.Listener):  # type: ignore[misc]  # numba has no type stubs
        printed = False

        def on_start(self, event: object) -> None:
            if not self.printed:
                print_line(_LINE)
            self.printed = True

        def on_end(self, event: object) -> None:
            """Do nothing; the listener must define this method."""

    with event.install_listener("numba:compile", FirstCompilation()):
        yield

"""Compiled kernels: compiled once, before anything fans out, and the user is told."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING

from headway_launch.console.output import tell

if TYPE_CHECKING:
    from headway.contracts.entries import EnvEntry
    from headway_launch.experiments.compose import Experiment

_LINE = "compiling kernels, once"


def compile_kernels(env: "EnvEntry") -> None:
    """Call `warm` of the modules that an environment preloads, where they have it. Left to themselves all
    training processes and workers would compile the same at the same time, and show no progress meanwhile."""
    _warm(env.preload)


def compile_kernels_of(experiments: "Iterable[Experiment]") -> None:
    """Those of what is to be trained: of environments, and of algorithms."""
    entries = [(experiment.env.preload, experiment.algo.kernels) for experiment in experiments]
    _warm(dict.fromkeys(name for of_env, of_algo in entries for name in (*of_env, *of_algo)))


def _warm(names: Iterable[str]) -> None:
    modules = [import_module(name) for name in names]
    for module in modules:
        if hasattr(module, "warm"):
            with _told_of_compiling():
                module.warm()


@contextmanager
def _told_of_compiling() -> Iterator[None]:
    """Tell when numba begins to compile; what it finds in its cache it only loads."""
    if "numba" not in sys.modules:
        yield
        return
    from numba.core import event

    class Teller(event.Listener):  # type: ignore[misc]  # numba comes without types
        told = False

        def on_start(self, event: object) -> None:
            if not self.told:
                tell(_LINE)
            self.told = True

        def on_end(self, event: object) -> None:
            """Of one function among many."""

    with event.install_listener("numba:compile", Teller()):
        yield

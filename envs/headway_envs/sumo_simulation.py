"""SUMO in this process, as one simulation per process.

libsumo would silently replace a simulation by a second one, so the owner of the simulation is recorded.
"""

import weakref
from collections.abc import Mapping
from contextlib import redirect_stdout
from importlib.util import find_spec
from io import StringIO
from tempfile import NamedTemporaryFile
from typing import Any

from headway.contracts import HeadwayError

INSTALL = 'the environment needs SUMO, which is not installed: pip install "headway[sumo]"'

COMMON_OPTIONS: Mapping[str, str] = {
    "collision.check-junctions": "true",
    "collision.mingap-factor": "0",  # physical overlap only
    "collision.action": "remove",  # one report per crash; `warn` repeats it at every step
    "time-to-teleport": "-1",
    "emissions.volumetric-fuel": "true",
    "no-step-log": "true",
    "no-warnings": "true",
    "duration-log.disable": "true",
}
"""SUMO's options in every environment."""
SUMO_CONTROL = -1.0
"""Commanded speed that returns control of a vehicle to SUMO."""

_owner: "weakref.ref[Simulation] | None" = None


def require_sumo() -> None:
    """Raise HeadwayError if libsumo is not installed, without importing it."""
    if find_spec("libsumo") is None:
        raise HeadwayError(INSTALL)


def libsumo() -> Any:  # noqa: ANN401 - libsumo has no types
    """Return the module libsumo. Raises HeadwayError if it is not installed or cannot be loaded."""
    require_sumo()
    try:
        # libsumo prints a warning about the order of imports with pyarrow, although both orders work.
        with redirect_stdout(StringIO()):
            import libsumo as module
    except ImportError as error:  # another Python, an old C library
        raise HeadwayError(f"libsumo cannot be loaded ({error}); {INSTALL}") from error
    return module


class Simulation:
    """One simulation, reloaded for every episode. Not picklable, and bound to the thread that starts it."""

    def __init__(self, network: str, options: Mapping[str, str]) -> None:
        """`network`: path of the network file; `options`: SUMO's other options by name, except the seed."""
        self._options = ["-n", network]
        self._options += [word for name, value in options.items() for word in (f"--{name}", value)]
        self.sumo = libsumo()

    def begin(self, seed: int, routes: str) -> None:
        """Load the network and start an episode; `routes`: content of a SUMO route file.

        Raises HeadwayError if another environment holds this process's simulation, or if SUMO cannot load the
        network.
        """
        global _owner
        owner = _owner() if _owner is not None else None
        if owner is not None and owner is not self:
            raise HeadwayError(
                "this process already holds a SUMO simulation, and can hold only one: close that environment "
                "first, or create this one in another process"
            )
        _owner = weakref.ref(self)
        with NamedTemporaryFile("w", suffix=".rou.xml", encoding="utf-8") as file:
            file.write(routes)
            file.flush()
            options = ["-r", file.name, "--seed", str(seed), *self._options]
            try:
                # Reloading is faster than closing and starting again.
                if self.sumo.simulation.isLoaded():
                    self.sumo.load(options)
                else:
                    self.sumo.start(["sumo", *options])
            except self.sumo.TraCIException as error:
                self.close()
                raise HeadwayError(
                    f"SUMO cannot load the network or the demand: {_one_line(error)}"
                ) from error

    def step(self) -> None:
        """Advance by one step.

        Raises HeadwayError if SUMO cannot go on, with a vehicle without a route for instance.
        """
        try:
            self.sumo.simulation.step()
        except (self.sumo.TraCIException, self.sumo.FatalTraCIError) as error:
            self.close()
            raise HeadwayError(f"SUMO stopped the episode: {_one_line(error)}") from error

    def close(self) -> None:
        """Release the simulation for other environments of this process."""
        global _owner
        if _owner is not None and _owner() is self:
            _owner = None
            self.sumo.close()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".")

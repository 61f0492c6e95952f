"""SUMO in this process. A process holds one simulation: a second would silently replace the first, so whoever
has it owns it."""

import weakref
from contextlib import redirect_stdout
from importlib.util import find_spec
from io import StringIO
from tempfile import NamedTemporaryFile
from typing import Any

from headway.contracts import HeadwayError

INSTALL = 'the intersection needs SUMO, which is not installed: pip install "headway[sumo]"'
_COMMON = {
    "collision.check-junctions": "true",
    "collision.mingap-factor": "0",  # physical overlap only
    "collision.action": "remove",  # one report a crash; `warn` repeats it at every step
    "time-to-teleport": "-1",
    "emissions.volumetric-fuel": "true",
    "no-step-log": "true",
    "no-warnings": "true",
    "duration-log.disable": "true",
}

_owner: "weakref.ref[Simulation] | None" = None


def require_sumo() -> None:
    """Raise HeadwayError where libsumo is not installed; nothing is imported."""
    if find_spec("libsumo") is None:
        raise HeadwayError(INSTALL)


def libsumo() -> Any:  # noqa: ANN401 - it comes without types
    """The module. Raises HeadwayError where it is not installed or cannot be loaded."""
    require_sumo()
    try:
        # It prints a guess about pyarrow, with which it works in either order of import.
        with redirect_stdout(StringIO()):
            import libsumo as module
    except ImportError as error:  # another Python, an old C library
        raise HeadwayError(f"libsumo cannot be loaded ({error}); {INSTALL}") from error
    return module


class Simulation:
    """One simulation, loaded anew for every episode. Not picklable, and for the thread that begins it."""

    def __init__(self, network: str, routes: str, step_s: float) -> None:
        """`network`: path of the network file; `routes`: content of a route file."""
        self._routes = routes
        common = [word for name, value in _COMMON.items() for word in (f"--{name}", value)]
        self._options = ["-n", network, "--step-length", str(step_s), *common]
        self.sumo = libsumo()

    def begin(self, seed: int) -> None:
        """Load the network anew. Raises HeadwayError where another environment has this process's simulation,
        and where SUMO cannot load it."""
        global _owner
        owner = _owner() if _owner is not None else None
        if owner is not None and owner is not self:
            raise HeadwayError(
                "this process holds a SUMO simulation already, and it can hold one: close that environment "
                "first, or make this one in a process of its own"
            )
        _owner = weakref.ref(self)
        with NamedTemporaryFile("w", suffix=".rou.xml", encoding="utf-8") as routes:
            routes.write(self._routes)
            routes.flush()
            options = ["-r", routes.name, "--seed", str(seed), *self._options]
            try:
                # Faster than closing it and starting another.
                if self.sumo.simulation.isLoaded():
                    self.sumo.load(options)
                else:
                    self.sumo.start(["sumo", *options])
            except self.sumo.TraCIException as error:
                self.close()
                raise HeadwayError(f"SUMO cannot load the intersection: {error}") from error

    def close(self) -> None:
        """Let another environment have it."""
        global _owner
        if _owner is not None and _owner() is self:
            _owner = None
            self.sumo.close()

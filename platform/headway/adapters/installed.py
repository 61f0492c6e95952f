"""Check of module names in configurations: only installed packages of environments are imported.

Configurations are shared between people, and importing a Python object runs its code, so configurations name
no Python objects. Module paths of environments are the exception, kept narrow: nothing is imported unless the
package's own metadata says that it depends on PettingZoo or, for MODULE:ID, on Gymnasium. The other
exception is a Python file, which a configuration names by its path.
"""

import importlib.metadata
import importlib.util
import json
import pkgutil
import re
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlparse

from headway.config.schema import nearest, suggestion
from headway.contracts import HeadwayError
from headway.contracts.errors import one_line

_PATH = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+")
_MODULE = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*")


def require_environment_module(name: str) -> None:
    """Raise HeadwayError unless `name` is a module of an installed package that depends on PettingZoo.

    Imports only the parent packages of the module, and only if the package qualifies.
    """
    if "/" in name or Path(name).is_file():
        raise HeadwayError(f"env.id={name} is not a Python file; give one, whose name ends in .py")
    if not _PATH.fullmatch(name):
        raise HeadwayError(
            f"env.id={name} is not a public module; write package.module, such as mpe2.simple_spread_v3"
        )
    _require_package(name.split(".")[0], ("PettingZoo",), name)
    above, _, last = name.rpartition(".")
    siblings = _modules_in(above)
    if last not in siblings:
        raise HeadwayError(f"env.id={name}: no such module; {suggestion(last, siblings, f'{above}.')}")


def require_registering_module(env_id: str) -> None:
    """Raise HeadwayError unless `env_id` is MODULE:ID, of a package that may register environments.

    It must be installed and depend on Gymnasium or PettingZoo. Imports nothing.
    """
    module = env_id.partition(":")[0]
    if not _MODULE.fullmatch(module):
        raise HeadwayError(f"env.id={env_id} is not MODULE:ID, such as gymnasium:CartPole-v1")
    _require_package(module.split(".")[0], ("Gymnasium", "PettingZoo"), env_id)


def _require_package(package: str, libraries: tuple[str, ...], env_id: str) -> None:
    spec = importlib.util.find_spec(package)
    own_file = Path(*env_id.split(".")).with_suffix(".py")
    or_file = f"; for your own file write env=./{own_file}" if own_file.is_file() else ""
    if spec is None:
        if (near := nearest(package, ("pettingzoo", "gymnasium"))) is not None:
            meant = env_id.replace(package, near, 1)
        elif importlib.util.find_spec("pettingzoo") and importlib.util.find_spec(f"pettingzoo.{package}"):
            meant = f"pettingzoo.{env_id}"
        else:
            meant = ""
        fix = f"did you mean env={meant}?" if meant else f"install it (pip install {package})"
        raise HeadwayError(
            f"env.id={env_id}: there is no package {package}; {fix}; or use a name that `headway list envs` "
            f"shows{or_file}"
        )
    if not any(_depends_on(library.lower(), package, spec.origin or "") for library in libraries):
        raise HeadwayError(
            f"env.id={env_id}: {package} is not an installed package that depends on "
            f"{' or '.join(libraries)}, and no other is imported; declare the dependency, or register the "
            f"environment by entry point headway.envs{or_file}"
        )


def _modules_in(package: str) -> list[str]:
    """Return the public modules of a package. Raises HeadwayError if the package cannot be imported."""
    try:
        spec = importlib.util.find_spec(package)
    except Exception as error:  # the package's own code
        raise HeadwayError(f"env.id: package {package} cannot be imported: {one_line(error)}") from error
    places = (spec.submodule_search_locations or []) if spec else []
    return [module.name for module in pkgutil.iter_modules(places) if not module.name.startswith("_")]


@cache
def _depends_on(library: str, package: str, origin: str) -> bool:
    needs = re.compile(rf"{library}\b", re.IGNORECASE)
    return any(
        _provides(distribution, package, origin)
        for distribution in importlib.metadata.distributions()
        if distribution.name.lower() == library or any(map(needs.match, distribution.requires or ()))
    )


def _provides(distribution: importlib.metadata.Distribution, package: str, origin: str) -> bool:
    """Return whether a distribution contains the package; `origin` is the package's file."""
    if any(file.parts[0] in (package, f"{package}.py") for file in distribution.files or ()):
        return True
    # An editable installation lists its folder, not its files.
    direct = json.loads(distribution.read_text("direct_url.json") or "{}")
    if not direct.get("dir_info", {}).get("editable"):
        return False
    return Path(origin).is_relative_to(unquote(urlparse(direct["url"]).path))

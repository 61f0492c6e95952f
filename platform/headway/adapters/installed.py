"""Check of module names in configurations: only installed packages that depend on PettingZoo are imported.

Configurations are shared between people, and importing a Python object runs its code, so configurations name
no Python objects. Module paths of environments are the exception, kept narrow: nothing is imported unless the
package's own metadata says that it depends on PettingZoo.
"""

import importlib.metadata
import importlib.util
import json
import pkgutil
import re
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlparse

from headway.config.schema import suggestion
from headway.contracts import HeadwayError
from headway.contracts.errors import one_line

_PATH = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+")
_ON_PETTINGZOO = re.compile(r"pettingzoo\b", re.IGNORECASE)


def require_environment_module(name: str) -> None:
    """Raise HeadwayError unless `name` is a module of an installed package that depends on PettingZoo.

    Imports only the parent packages of the module, and only if the package qualifies.
    """
    if not _PATH.fullmatch(name):
        raise HeadwayError(
            f"env.id={name} is not a public module; write package.module, such as mpe2.simple_spread_v3"
        )
    package = name.split(".")[0]
    spec = importlib.util.find_spec(package)
    if spec is None:
        raise HeadwayError(
            f"env.id={name}: there is no package {package}; install it (pip install {package}), "
            "or use a name that `headway list envs` shows"
        )
    if not _depends_on_pettingzoo(package, spec.origin or ""):
        raise HeadwayError(
            f"env.id={name}: {package} is not an installed package that depends on PettingZoo, and no other "
            "is imported; declare the dependency, or register the environment by entry point headway.envs"
        )
    above, _, last = name.rpartition(".")
    siblings = _modules_in(above)
    if last not in siblings:
        raise HeadwayError(f"env.id={name}: no such module; {suggestion(last, siblings, f'{above}.')}")


def _modules_in(package: str) -> list[str]:
    """Return the public modules of a package. Raises HeadwayError if the package cannot be imported."""
    try:
        spec = importlib.util.find_spec(package)
    except Exception as error:  # the package's own code
        raise HeadwayError(f"env.id: package {package} cannot be imported: {one_line(error)}") from error
    places = (spec.submodule_search_locations or []) if spec else []
    return [module.name for module in pkgutil.iter_modules(places) if not module.name.startswith("_")]


@cache
def _depends_on_pettingzoo(package: str, origin: str) -> bool:
    for distribution in importlib.metadata.distributions():
        needs = any(_ON_PETTINGZOO.match(requirement) for requirement in distribution.requires or ())
        if (needs or distribution.name.lower() == "pettingzoo") and _provides(distribution, package, origin):
            return True
    return False


def _provides(distribution: importlib.metadata.Distribution, package: str, origin: str) -> bool:
    """Return whether a distribution contains the package; `origin` is the package's file."""
    if any(file.parts[0] in (package, f"{package}.py") for file in distribution.files or ()):
        return True
    # An editable installation lists its folder, not its files.
    direct = json.loads(distribution.read_text("direct_url.json") or "{}")
    if not direct.get("dir_info", {}).get("editable"):
        return False
    return Path(origin).is_relative_to(unquote(urlparse(direct["url"]).path))

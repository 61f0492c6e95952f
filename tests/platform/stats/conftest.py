"""rliable needs the bootstrap of `arch` alone. The rest of arch 7 (rliable takes no newer one), which its
`__init__` imports, does not load beside pandas 3."""

import importlib.util
import sys
from types import ModuleType

_found = importlib.util.find_spec("arch")
if _found is not None and "arch" not in sys.modules:
    _package = ModuleType("arch")
    _package.__path__ = list(_found.submodule_search_locations or ())
    sys.modules["arch"] = _package

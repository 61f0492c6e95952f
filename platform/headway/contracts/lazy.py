"""Functions and classes named by a string, imported when they are first called."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Lazy:
    """A callable named by `"module:attribute"`, for registries, and imported at its first call.

    It is pickled as its name, so that light workers and `--help` import only what they call.
    """

    target: str
    """For example `"headway_envs.bus.env:BusBatchedEnv"`."""

    def load(self) -> Any:  # noqa: ANN401 - whatever the name stands for
        """Return the attribute of the module. Raises ImportError or AttributeError if there is none."""
        module, _, attribute = self.target.partition(":")
        return getattr(import_module(module), attribute)

    def __call__(self, *arguments: Any, **named: Any) -> Any:  # noqa: ANN401 - as the callable has them
        return self.load()(*arguments, **named)


def lazy_attributes(module: str, targets: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a `__getattr__` (PEP 562) for `module` that imports the `targets`, name to `"module:attribute"`.

    A target without `:attribute` is a module.
    """

    def get(name: str) -> Any:  # noqa: ANN401 - whatever the name stands for
        if name not in targets:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        target = targets[name]
        return Lazy(target).load() if ":" in target else import_module(target)

    return get

"""Named algorithms, one short file each: equations, source and composition."""

from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from headway_algos.recipe import Recipe
    from headway_algos.replay_config import ReplayRecipe


@cache
def recipes() -> dict[str, "Recipe | ReplayRecipe"]:
    """Return the recipes of this folder's modules, by name."""
    modules = [import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)]
    return {module.RECIPE.name: module.RECIPE for module in modules}

"""Updates and critics by name: Headway's own, and those of other packages. Importing it imports no torch."""

from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from headway.contracts import Lazy

if TYPE_CHECKING:
    from headway_algos.on_policy.critics import MakeCritic
    from headway_algos.on_policy.updates import MakeUpdate

UPDATES: dict[str, "MakeUpdate"] = {
    "ppo": Lazy("headway_algos.on_policy.updates:ppo_update"),
    "a2c": Lazy("headway_algos.on_policy.updates:a2c_update"),
    "trpo": Lazy("headway_algos.on_policy.updates.trpo:TRPO"),
    "kfac": Lazy("headway_algos.on_policy.updates.kfac:KFAC"),
}
CRITICS: dict[str, "MakeCritic"] = {
    "local": Lazy("headway_algos.on_policy.critics.value:ValueCritic"),
    "central": Lazy("headway_algos.on_policy.critics.value:ValueCritic"),
    "counterfactual": Lazy("headway_algos.on_policy.critics.counterfactual:CounterfactualCritic"),
}


def updates() -> Mapping[str, "MakeUpdate"]:
    """Return factories of updates by name: Headway's, and entry points of the group `headway.updates`."""
    return {**_others("headway.updates"), **UPDATES}


def critics() -> Mapping[str, "MakeCritic"]:
    """Return factories of critics by name: Headway's, and entry points of the group `headway.critics`."""
    return {**_others("headway.critics"), **CRITICS}


def _others(group: str) -> dict[str, Any]:
    return {point.name: Lazy(point.value) for point in entry_points(group=group)}

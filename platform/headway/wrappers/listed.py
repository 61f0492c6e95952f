"""The list `env.wrappers` as records: `[{name: frame_stack_v1, stack_size: 4}, clip_reward_v0]`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from headway.config.schema import build, plain
from headway.contracts import HeadwayError, WrapperEntry
from headway.registry import wrapper_entry


@dataclass(frozen=True)
class ListedWrapper:
    """One wrapper of the list."""

    name: str
    entry: WrapperEntry
    arguments: Any
    """A record of class `entry.config`."""
    path: str
    """Configuration key that names the wrapper, for messages."""

    @property
    def mapping(self) -> dict[str, Any]:
        """The wrapper as YAML writes it, every default spelt out."""
        return {"name": self.name, **plain(self.arguments)}


def listed_wrappers(items: Sequence[Any]) -> tuple[ListedWrapper, ...]:
    """Return the wrappers of a list in order; items are names, or mappings of `name` and arguments.

    Raises HeadwayError, suggesting the nearest name, for an unknown wrapper or argument.
    """
    return tuple(_listed(item, f"env.wrappers[{index}]") for index, item in enumerate(items))


def _listed(item: Any, path: str) -> ListedWrapper:  # noqa: ANN401 - whatever YAML holds
    """Return one item of the list, validated; `path` is its key."""
    arguments = {"name": item} if isinstance(item, str) else item
    if not isinstance(arguments, Mapping) or not isinstance(arguments.get("name"), str):
        raise HeadwayError(
            f"{path}={item} is not a wrapper; write a name, or its arguments too, such as "
            "{name: frame_stack_v1, stack_size: 4}"
        )
    name = arguments["name"]
    entry = wrapper_entry(name, path)
    rest = {key: value for key, value in arguments.items() if key != "name"}
    return ListedWrapper(name, entry, build(entry.config, rest, path, name), path)

"""From the keys `env.*` to an environment's entry with its wrappers."""

from dataclasses import dataclass
from typing import Any

from headway.config import EnvConfig
from headway.contracts import EnvEntry, HeadwayError
from headway.registry import env_entries, env_entry

_ADAPTERS = ("shared_reward", "agents_come_and_go", "max_copies_per_process")


@dataclass(frozen=True)
class ChosenEnv:
    """An environment and what is around it."""

    entry: EnvEntry
    """What is reported on: with all wrappers but those that only change rewards."""
    training_entry: EnvEntry
    """What is learned from: with all wrappers. The same `make` serves both."""
    mapping: dict[str, Any]
    """What `env.*` has beside `id` and `args`, with every argument spelt out; keys that say nothing are left
    out."""


def chosen_env(config: EnvConfig) -> ChosenEnv:
    """The environment that a configuration names.

    Raises HeadwayError for an id, a wrapper or a wrapper's argument that does not exist, and for a key that
    is not this environment's.
    """
    said = {key: value for key in _ADAPTERS if (value := getattr(config, key)) is not None}
    is_module = "." in config.id and config.id not in env_entries()
    if said and not is_module:
        raise HeadwayError(
            f"env.{next(iter(said))} is for PettingZoo environments by module; {config.id} says it itself"
        )
    entry = _module_entry(config) if is_module else env_entry(config.id)
    if not config.wrappers:
        return ChosenEnv(entry, entry, said)
    from headway.wrappers.listed import listed_wrappers
    from headway.wrappers.wrapping import wrapped_entry

    wrappers = listed_wrappers(config.wrappers)
    listed = {"wrappers": [wrapper.mapping for wrapper in wrappers]}
    training = reported = wrapped_entry(config.id, entry, wrappers)
    if any(wrapper.entry.only_rewards for wrapper in wrappers):
        lasting = [wrapper for wrapper in wrappers if not wrapper.entry.only_rewards]
        reported = wrapped_entry(config.id, entry, lasting)
    return ChosenEnv(reported, training, {**said, **listed})


def _module_entry(config: EnvConfig) -> EnvEntry:
    from headway.adapters.modules import module_entry
    from headway.adapters.parallel_entry import AdapterOptions

    options = AdapterOptions(
        shared_reward=bool(config.shared_reward),
        agents_come_and_go=config.agents_come_and_go,
        max_copies_per_process=config.max_copies_per_process,
    )
    return module_entry(config.id, options, {**config.args, **config.training_args})


def notices_of(prepared: object) -> tuple[str, ...]:
    """What the user is to be told about a prepared environment."""
    return tuple(getattr(prepared, "notices", ()))

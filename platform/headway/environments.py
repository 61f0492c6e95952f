"""From the keys `env.*` to an environment's entry with its wrappers."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from headway.config.experiment import EnvConfig
from headway.contracts import EnvEntry, HeadwayError
from headway.registry import env_entry, is_module_path

_ADAPTERS = ("shared_reward", "agents_come_and_go", "max_copies_per_process")


@dataclass(frozen=True)
class ChosenEnv:
    """An environment and what is around it."""

    entry: EnvEntry
    """What is reported on: with all wrappers but those that only change rewards."""
    training_entry: EnvEntry
    """What is learned from: with all wrappers. The same `make` serves both. Where only the arguments given
    tell what an environment takes, its `config` has those of `training_args`, too."""
    mapping: dict[str, Any]
    """What `env.*` has beside `id` and `args`, with every argument spelt out; keys that say nothing are left
    out."""


def chosen_env(config: EnvConfig) -> ChosenEnv:
    """The environment that a configuration names.

    Raises HeadwayError for an id, a wrapper or a wrapper's argument that does not exist, and for a key that
    is not this environment's.
    """
    said = {key: value for key in _ADAPTERS if (value := getattr(config, key)) is not None}
    is_module = is_module_path(config.id)
    if said and not is_module:
        raise HeadwayError(
            f"env.{next(iter(said))} is for PettingZoo environments by module; {config.id} says it itself"
        )
    entry = training = _module_entry(config, config.args) if is_module else env_entry(config.id)
    if is_module and config.training_args:
        training = _module_entry(config, {**config.args, **config.training_args})
    if not config.wrappers:
        return ChosenEnv(entry, training, said)
    from headway.wrappers.listed import listed_wrappers
    from headway.wrappers.wrapped_env import wrapped_entry

    wrappers = listed_wrappers(config.wrappers)
    listed = {"wrappers": [wrapper.mapping for wrapper in wrappers]}
    lasting = [wrapper for wrapper in wrappers if not wrapper.entry.only_rewards]
    reported = wrapped_entry(config.id, entry, lasting)
    learned_from = reported
    if training is not entry or len(lasting) < len(wrappers):
        learned_from = wrapped_entry(config.id, training, wrappers)
    return ChosenEnv(reported, learned_from, {**said, **listed})


def _module_entry(config: EnvConfig, arguments: Iterable[str]) -> EnvEntry:
    from headway.adapters.modules import module_entry
    from headway.adapters.parallel_entry import AdapterOptions

    options = AdapterOptions(
        shared_reward=bool(config.shared_reward),
        agents_come_and_go=config.agents_come_and_go,
        max_copies_per_process=config.max_copies_per_process,
    )
    return module_entry(config.id, options, arguments)


def notices_of(prepared: object) -> tuple[str, ...]:
    """What the user is to be told about a prepared environment."""
    return tuple(getattr(prepared, "notices", ()))

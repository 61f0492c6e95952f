"""Choice of an environment entry and its wrappers by the configuration keys `env.*`."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from headway.adapters.env_file import EnvFile, is_file_id
from headway.config.experiment import EnvConfig
from headway.contracts import EnvEntry, HeadwayError
from headway.registry import env_entry, is_external

_MODULE_KEYS = ("shared_reward", "agents_come_and_go", "max_copies_per_process", "file_digest")


@dataclass(frozen=True)
class ChosenEnv:
    """The environment that a configuration names, with its wrappers."""

    entry: EnvEntry
    """Environment of evaluation and reports: with all wrappers except those that only change rewards."""
    training_entry: EnvEntry
    """Environment of training: with all wrappers. Both entries have the same `make`. For an environment that
    takes any keyword, `config` has the keys of `args` and also those of `training_args` and of stages."""
    mapping: dict[str, Any]
    """The keys of `env.*` except `id` and `args`, with all arguments of wrappers written out. Keys left at
    null or empty are omitted."""


def chosen_env(config: EnvConfig, of_stages: Iterable[str] = ()) -> ChosenEnv:
    """Return the environment that a configuration names. `of_stages`: names of the arguments that training
    stages set.

    Raises HeadwayError for an unknown id, wrapper or wrapper argument, and for a key that this environment
    does not take.
    """
    options = {key: value for key in _MODULE_KEYS if (value := getattr(config, key)) is not None}
    external = is_external(config.id)
    own = None if external else env_entry(config.id)
    refused = options if own is None or own.digest is None else options.keys() - {"file_digest"}
    if refused and not external:
        raise HeadwayError(
            f"env.{next(iter(refused))} is for PettingZoo and Gymnasium environments only; remove it, "
            f"since {config.id} defines it itself"
        )
    if is_file_id(config.id):
        options.setdefault("file_digest", EnvFile.read(config.id).digest)
    elif external and config.file_digest is not None:
        raise HeadwayError(
            f"env.file_digest is for Python files only; remove it, since {config.id} is not one"
        )
    entry = training = own or _module_entry(config, config.args)
    of_training = (*(config.training_args or {}), *of_stages)
    if external and of_training:
        training = _module_entry(config, dict.fromkeys((*config.args, *of_training)))
    if not config.wrappers:
        return ChosenEnv(entry, training, options)
    # Imported here: they import Gymnasium, which most runs without wrappers do not need.
    from headway.wrappers.listed import listed_wrappers
    from headway.wrappers.wrapped_env import wrapped_entry

    wrappers = listed_wrappers(config.wrappers)
    listed = {"wrappers": [wrapper.mapping for wrapper in wrappers]}
    evaluation_wrappers = [wrapper for wrapper in wrappers if not wrapper.entry.only_rewards]
    evaluation_entry = wrapped_entry(config.id, entry, evaluation_wrappers)
    training_entry = evaluation_entry
    if training is not entry or len(evaluation_wrappers) < len(wrappers):
        training_entry = wrapped_entry(config.id, training, wrappers)
    return ChosenEnv(evaluation_entry, training_entry, {**options, **listed})


def _module_entry(config: EnvConfig, arguments: Iterable[str]) -> EnvEntry:
    from headway.adapters.modules import module_entry
    from headway.adapters.pettingzoo import AdapterOptions

    options = AdapterOptions(
        shared_reward=config.shared_reward,
        agents_come_and_go=config.agents_come_and_go,
        max_copies_per_process=config.max_copies_per_process,
    )
    return module_entry(config.id, options, arguments, config.file_digest)

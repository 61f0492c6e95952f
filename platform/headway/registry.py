"""Environments, algorithms and wrappers by name, the project's own and those of other packages.

Other packages add theirs by entry point (`headway.envs`, `headway.algos`, `headway.wrappers`). On-policy
components have separate entry-point groups: see `headway_algos.components`.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any, TypeVar

from headway.config.schema import suggestion
from headway.contracts.entries import LOOKAHEAD, AlgoEntry, EnvEntry, RuleEntry, is_lookahead
from headway.contracts.errors import HeadwayError, one_line
from headway.contracts.random_rule import RANDOM
from headway.contracts.wrapper import WrapperEntry
from headway.rollout.checked_rule import CheckedRule
from headway.rollout.lookahead import SAMPLES, STEPS, Lookahead

Entry = TypeVar("Entry", EnvEntry, AlgoEntry, WrapperEntry)


@cache
def env_entries() -> Mapping[str, EnvEntry]:
    """Return every environment by name, each with the rule `random`.

    Raises HeadwayError if a package's entry point cannot be loaded or two packages use one name.
    """
    return {
        name: entry if "random" in entry.rules else replace(entry, rules={"random": RANDOM, **entry.rules})
        for name, entry in _load("headway.envs", EnvEntry).items()
    }


@cache
def algo_entries() -> Mapping[str, AlgoEntry]:
    """Return every algorithm by name.

    Raises HeadwayError if a package's entry point cannot be loaded or two packages use one name.
    """
    return _load("headway.algos", AlgoEntry)


@cache
def wrapper_entries() -> Mapping[str, WrapperEntry]:
    """Return every wrapper by name: SuperSuit's and those of other packages.

    Raises HeadwayError if a package's entry point cannot be loaded or uses a name that is taken.
    """
    from headway.wrappers.supersuit import supersuit_entries

    return _load("headway.wrappers", WrapperEntry, supersuit_entries())


def env_entry(name: str) -> EnvEntry:
    """Return the entry of a registered environment, or of one that `is_external`.

    Raises HeadwayError, suggesting the nearest name, if there is none.
    """
    if is_external(name):
        from headway.adapters.env_file import absolute_id
        from headway.adapters.modules import module_entry

        return module_entry(absolute_id(name))
    return _named(env_entries(), name, "environment")


def is_external(name: str) -> bool:
    """Return whether `name` locates the code of an environment instead of naming a registered one.

    Such a name is a PettingZoo module (`mpe2.simple_spread_v3`), a Python file (`./shuttle.py`) or MODULE:ID
    (`gymnasium:CartPole-v1`).
    """
    return ("." in name or ":" in name) and name not in env_entries()


def algo_entry(name: str) -> AlgoEntry:
    """Return the algorithm with this name.

    Raises HeadwayError, suggesting the nearest name, if there is none.
    """
    return _named(algo_entries(), name, "algorithm")


def hashed_parameters(algorithm: str, parameters: Mapping[str, str]) -> Mapping[str, str]:
    """Return a cell's parameters (dotted key -> text) in the form that is hashed, the same in all versions.

    Obsolete keys are added, and newer keys are dropped if their value reproduces the earlier behaviour, so
    that old and new runs of one configuration belong to one cell. Returned unchanged if the algorithm is not
    installed.
    """
    try:
        entry = algo_entries()[algorithm]
    except (HeadwayError, KeyError):
        return parameters
    obsolete = {f"algo.{key}": str(value) for key, value in entry.obsolete_keys.items()}
    before = {f"algo.{key}": str(value) for key, value in getattr(entry.config, "VALUES_BEFORE", {}).items()}
    return {key: value for key, value in {**obsolete, **parameters}.items() if before.get(key) != value}


def rule_names(env: EnvEntry) -> tuple[str, ...]:
    """Return the names of an environment's rules, `lookahead` included if there is one."""
    return (*env.rules, *([] if env.lookahead is None else [LOOKAHEAD]))


def rule_entry(env: EnvEntry, name: str) -> RuleEntry:
    """Return the rule with this name: one of the entry's, or `lookahead[:RULE[:STEPS[:SAMPLES]]]`.

    Raises HeadwayError, suggesting the nearest name, if there is none.
    """
    if not is_lookahead(name):
        if name in env.rules:
            own = env.rules[name]
            return own if own.internal else replace(own, make=lambda data: CheckedRule(name, own.make(data)))
        raise HeadwayError(f"unknown rule {name!r}; {suggestion(name, rule_names(env))}")
    if env.lookahead is None:
        raise HeadwayError(
            f"rule {LOOKAHEAD} needs an environment that can be simulated ahead, without wrappers "
            "other than reward wrappers; leave it out"
        )
    form = f"{LOOKAHEAD}:RULE:STEPS:SAMPLES"
    _, base, *numbers = [*name.split(":"), *(env.lookahead,) * (":" not in name)]
    if len(numbers) > 2 or not all(number.isdecimal() and int(number) for number in numbers):
        raise HeadwayError(
            f"{name!r} must have the form {form}, with whole numbers of steps and samples from 1 on, such as "
            f"{LOOKAHEAD}:{env.lookahead}:{STEPS}:{SAMPLES}"
        )
    # What `random` draws would differ between the actions that are compared.
    bases = {rule: entry for rule, entry in env.rules.items() if entry is not RANDOM}
    if base not in bases:
        raise HeadwayError(f"{name}: {base!r} is not a rule to improve on; {suggestion(base, bases)}")
    own = rule_entry(env, base)
    steps, samples = [*map(int, numbers), *(STEPS, SAMPLES)[len(numbers) :]]
    return RuleEntry(
        f"reference for the possible gain: tries actions in {samples} simulations of {steps} steps of {base}",
        lambda prepared: Lookahead(env.make, env.simulated(prepared), own.make(prepared), steps, samples),
    )


def wrapper_entry(name: str, path: str = "") -> WrapperEntry:
    """Return the wrapper with this name; `path` is the configuration key that names it, for messages.

    Raises HeadwayError, suggesting the nearest name, if there is none, and with the reason if the wrapper
    cannot be used from YAML (it takes Python functions, for instance).
    """
    from headway.wrappers.supersuit import supersuit_names, why_not

    reason = why_not(name) if name in supersuit_names() and name not in wrapper_entries() else None
    before = f"{path}: " if path else ""
    if reason is not None:
        raise HeadwayError(f"{before}{name} cannot be used: {reason}")
    return _named(wrapper_entries(), name, "wrapper", before)


def _named(entries: Mapping[str, Entry], name: str, kind: str, before: str = "") -> Entry:
    try:
        return entries[name]
    except KeyError:
        raise HeadwayError(f"{before}unknown {kind} {name!r}; {suggestion(name, entries)}") from None


def _load(
    group: str, kind: type[Entry], built_in: Mapping[str, Entry] = MappingProxyType({})
) -> Mapping[str, Entry]:
    entries: dict[str, Entry] = dict(built_in)
    for point in entry_points(group=group):
        origin = point.dist.name if point.dist else point.value
        try:
            added: Any = point.load()
        except Exception as error:
            raise HeadwayError(
                f"{point.value} of package {origin} cannot be loaded ({one_line(error)}); "
                "fix or uninstall that package"
            ) from error
        if not isinstance(added, Mapping) or not all(isinstance(entry, kind) for entry in added.values()):
            raise HeadwayError(
                f"{point.value} of package {origin} must be a mapping from names to {kind.__name__}"
            )
        for name, entry in added.items():
            if name in entries:
                raise HeadwayError(f"{name!r} is registered twice in {group}, once by package {origin}")
            entries[name] = entry
    return dict(sorted(entries.items()))

"""`headway list`: list names of environments, algorithms and so on, and their keys."""

import argparse
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from headway.config.experiment import RolloutConfig
from headway.config.schema import FieldDescription, describe, nearest, suggestion
from headway.contracts import RANDOM, RuleEntry
from headway.contracts.errors import HeadwayError
from headway.registry import (
    algo_entries,
    algo_entry,
    env_entries,
    env_entry,
    is_external,
    rule_entry,
    rule_names,
    wrapper_entries,
    wrapper_entry,
)
from headway_launch.commands.arguments import add_config_dir_argument
from headway_launch.console.output import print_line
from headway_launch.console.tables import print_table
from headway_launch.experiments.options import config_file, options, summary_of
from headway_launch.experiments.override_words import require_each_key_once
from headway_launch.experiments.yaml_file import read_mapping

EXAMPLES = """\
examples:
  headway list                 what can be listed
  headway list envs            all environments
  headway list envs bus        arguments of one environment (env.args.KEY=VALUE)
  headway list envs mpe2.simple_spread_v3      arguments of a PettingZoo environment, by its module
  headway list envs ./shuttle.py               or by its file
  headway list envs gymnasium:CartPole-v1      arguments of a Gymnasium environment
  headway list wrappers        all wrappers (env.wrappers='[{name: frame_stack_v1, stack_size: 4}]')
  headway list algos mappo     hyper-parameters of one algorithm (algo.KEY=VALUE)
  headway list rules bus       classical rules of one environment
  headway list metrics bus     episode metrics of one environment, with units
  headway list observations bus                the numbers of an observation, with units and scales
  headway list observations bus env.args.observation=paper      with keys as in `headway run`
  headway list experiments     names for `headway run experiment=NAME`
  headway list searches        names for `headway search NAME`
  headway list spaces          pieces of search spaces, for files in configs/search
  headway list keys            all keys of an experiment
  headway list keys lr         those with `lr` in their name
  headway list schema > headway.schema.json    JSON Schema of experiments' files, for editors
  headway list schema preset                   or of files in configs/preset, env, search, space
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add KIND and NAME."""
    parser.add_argument("kind", metavar="KIND", nargs="?", help=f"{', '.join(KINDS)}; omit to explain them")
    parser.add_argument("name", metavar="NAME", nargs="?", help="show this one in full")
    parser.add_argument(
        "overrides", metavar="KEY=VALUE", nargs="*", help="keys of the environment, for observations only"
    )
    add_config_dir_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Print the list, one item in full or, without a kind, the kinds."""
    if arguments.kind is None:
        print_table(("kind", "what is listed"), [(name, said) for name, (said, _) in KINDS.items()])
        print_line("`headway list KIND` lists them; `headway list KIND NAME` shows one in full")
        return 0
    if arguments.kind not in KINDS:
        near = nearest(arguments.kind, [*KINDS, *_WRITTEN_OUT]) or arguments.kind
        meant = suggestion(_WRITTEN_OUT.get(near, near), KINDS, "headway list ")
        raise HeadwayError(f"{arguments.kind!r} cannot be listed; {meant}")
    if arguments.overrides and arguments.kind != "observations":
        raise HeadwayError(
            f"headway list {arguments.kind} takes one name: leave out {' '.join(arguments.overrides)}"
        )
    _, show = KINDS[arguments.kind]
    show(arguments.name, *arguments.overrides)
    return 0


def _list_envs(name: str | None) -> None:
    if name is None:
        summaries = {key: entry.summary for key, entry in env_entries().items()}
        summaries |= {option: summary_of("env", option) for option in _file_only_envs()}
        rows = [(key, summary, ", ".join(rules_of(key))) for key, summary in summaries.items()]
        print_table(("environment", "description", "rules"), rows)
        print_line(
            "others are chosen by their PettingZoo module (env=mpe2.simple_spread_v3), Python file "
            "(env=./shuttle.py) or id (env=pettingzoo:sisl/pursuit-v5)"
        )
    elif name in _file_only_envs():
        _list_group("env", name)
    elif keys := describe(env_entry(_require_env(name)).config, "env.args"):
        _print_descriptions(keys)
    else:
        from headway.adapters.factories import takes_any_keyword

        anything = is_external(name) and takes_any_keyword(name)
        passed_on = "does not list its arguments: any env.args.KEY=VALUE is passed on to it"
        print_line(f"{name} {passed_on if anything else 'takes no arguments'}")


def _list_algos(name: str | None) -> None:
    if name is None:
        described = [(key, entry.summary, entry.source) for key, entry in algo_entries().items()]
        print_table(("algorithm", "description", "source"), described)
        return
    _print_descriptions(algorithm_keys(name))


def algorithm_keys(name: str) -> list[FieldDescription]:
    """Return the keys of `algo` that an algorithm reads, and those of `rollout` with its defaults.

    Raises HeadwayError if there is no such algorithm.
    """
    entry = algo_entry(name)
    keys = list(describe(entry.config, "algo"))
    if all(key.default != "required" for key in keys):
        own = entry.rollout(entry.config())
        keys += [
            replace(key, default=str(own.get(key.key.removeprefix("rollout."), key.default)))
            for key in describe(RolloutConfig, "rollout")
        ]
    return keys


def _list_wrappers(name: str | None) -> None:
    if name is not None:
        _print_descriptions(describe(wrapper_entry(name).config))
        return
    rows = []
    for key, entry in wrapper_entries().items():
        keys = describe(entry.config)
        arguments = [row.key if row.default == "required" else f"{row.key}={row.default}" for row in keys]
        rows.append((key, ", ".join(arguments), "yes" if entry.batched else "no", entry.summary))
    print_table(("wrapper", "arguments", "batched", "description"), rows)


def _require_env(name: str) -> str:
    """Return `name`. Raises HeadwayError if it neither names an environment nor locates the code of one."""
    if is_external(name) or name in _names(None):
        return name
    raise HeadwayError(f"unknown environment {name!r}; {suggestion(name, _names(None))}")


def _file_only_envs() -> list[str]:
    """Return the environments that are defined only by a file of `configs/env`."""
    return [option for option in options()["env"] if option not in env_entries()]


def _registered_id(name: str) -> str | None:
    """Return the registered environment that the file `name` configures, or `name` if there is no such file.

    None if the file configures a PettingZoo module.
    """
    if name not in _file_only_envs():
        return _require_env(name)
    own = read_mapping(config_file("env", name)).get("id")
    return own if own in env_entries() else None


def rules_of(name: str) -> Mapping[str, RuleEntry]:
    """Return the rules of an environment or configuration file; only `random` for a file that configures a
    PettingZoo module."""
    own = _registered_id(name)
    if own is None:
        return {"random": RANDOM}
    entry = env_entry(own)
    return {rule: rule_entry(entry, rule) for rule in rule_names(entry)}


def metrics_of(name: str) -> Mapping[str, str]:
    """Return the metrics of an environment's episodes with their descriptions.

    Empty if the environment describes none.
    """
    own = _registered_id(name)
    metrics = {} if own is None else env_entry(own).metrics
    return {**COMMON_METRICS, **metrics} if metrics else {}


def _names(name: str | None) -> list[str]:
    """Return [`name`] or, if it is None, all environments, including those defined only by a file."""
    return [*env_entries(), *_file_only_envs()] if name is None else [name]


def _list_rules(name: str | None) -> None:
    rows = [(env, rule, entry.summary) for env in _names(name) for rule, entry in rules_of(env).items()]
    print_table(("environment", "rule", "description"), rows, whole=("rule",))


def _list_metrics(name: str | None) -> None:
    described = {key: metrics for key in _names(name) if (metrics := metrics_of(key))}
    if not described:
        describing = ", ".join(key for key in _names(None) if metrics_of(key))
        raise HeadwayError(
            f"{name} does not describe its metrics: its file needs METRICS, or its EnvEntry `metrics`; "
            f"environments that do: {describing}"
        )
    rows = [(key, metric, text) for key, of_env in described.items() for metric, text in of_env.items()]
    print_table(("environment", "metric", "description"), rows, whole=("metric",), spare=("environment",))


def observation_rows(name: str, overrides: Sequence[str] = ()) -> list[tuple[str, ...]]:
    """Return index, name, unit, scale and meaning of each number of an environment's observation, as its
    arguments and wrappers make it.

    Raises HeadwayError if the environment cannot be made or does not describe them.
    """
    from headway_launch.experiments.compose import compose

    words = [f"env={name}", *overrides]
    require_each_key_once(words)
    spec = compose(words).prepare_environment().spec
    if not spec.observation_features:
        raise HeadwayError(
            f"{name} does not describe the {spec.observation_size} numbers of its observations; "
            "an environment with an EnvEntry does so by `observation_features` in its EnvSpec"
        )
    return [
        (str(index), feature.name, feature.unit, f"{feature.scale:.10g}", feature.meaning)
        for index, feature in enumerate(spec.observation_features)
    ]


def _list_observations(name: str | None, *overrides: str) -> None:
    if name is None:
        raise HeadwayError("name an environment, such as `headway list observations bus`")
    rows = observation_rows(name, overrides)
    print_table(("index", "name", "unit", "scale", "meaning"), rows, whole=("name",))


def _list_keys(word: str | None) -> None:
    """Print every key, or those with `word` in their name or, if there are none, in their description.

    Keys of `algo` and `env.args` appear once per default and description, with the algorithms or environments
    that have them.
    """
    from headway.config.experiment import ExperimentConfig

    owners: dict[FieldDescription, list[str]] = {
        key: [] for key in describe(ExperimentConfig) if key.key not in ("algo", "env.args")
    }
    for name, algo in algo_entries().items():
        for key in describe(algo.config, "algo"):
            owners.setdefault(key, []).append(name)
    for name, env in env_entries().items():
        for key in describe(env.config, "env.args"):
            owners.setdefault(key, []).append(name)
    found = sorted(owners, key=lambda key: key.key.split(".")[0])  # stable: groups stay together
    if word is not None:
        by_name = [key for key in found if word.lower() in key.key.lower()]
        found = by_name or [key for key in found if word.lower() in key.doc.lower()]
    if not found:
        known, asked = {key.key for key in owners}, word or ""
        hint = suggestion(asked, known) if nearest(asked, known) else "`headway list keys` lists all"
        raise HeadwayError(f"no key contains {word!r}; {hint}")
    rows = [(key.key, key.type, key.default, ", ".join(owners[key]), key.doc) for key in found]
    print_table(("key", "type", "default", "of", "description"), rows, whole=("key",), spare=("type",))


def _list_schema(kind: str | None) -> None:
    from headway_launch.experiments.file_schema import FILE_KINDS, file_schema

    chosen = kind or "experiment"
    if chosen not in FILE_KINDS:
        raise HeadwayError(f"there is no schema of {chosen!r}; {suggestion(chosen, FILE_KINDS)}")
    print(json.dumps(file_schema(chosen), indent=1, allow_nan=False))


def _list_group(group: str, name: str | None) -> None:
    names = options()[group]
    if name is None:
        print_table((group, "description"), [(option, summary_of(group, option)) for option in names])
    elif name in names:
        print(config_file(group, name).read_text(encoding="utf-8"), end="")
    else:
        raise HeadwayError(f"unknown {group} {name!r}; {suggestion(name, names)}")


def _print_descriptions(keys: Iterable[FieldDescription]) -> None:
    rows = [(key.key, key.type, key.default, key.doc) for key in keys]
    print_table(("key", "type", "default", "description"), rows, whole=("key",))


COMMON_METRICS = {
    "length": "steps per episode",
    "return": "sum of rewards over the episode, mean over agents",
}
"""Metrics of every environment."""
KINDS: Mapping[str, tuple[str, Callable[..., None]]] = {
    "envs": ("environments: their rules, or the arguments of one (env.args.KEY=VALUE)", _list_envs),
    "algos": ("algorithms, or the hyper-parameters of one (algo.KEY=VALUE)", _list_algos),
    "wrappers": ("wrappers for env.wrappers, or the arguments of one", _list_wrappers),
    "rules": ("classical rules of all environments, or of one", _list_rules),
    "metrics": ("episode metrics of all environments, or of one, with units", _list_metrics),
    "observations": (
        "numbers of an environment's observation, with units and scales; needs a NAME",
        _list_observations,
    ),
    "experiments": ("experiments for `headway run experiment=NAME`", partial(_list_group, "experiment")),
    "presets": ("hyper-parameter presets for preset=NAME", partial(_list_group, "preset")),
    "searches": ("hyper-parameter searches for `headway search NAME`", partial(_list_group, "search")),
    "spaces": ("pieces of search spaces, for files in configs/search", partial(_list_group, "space")),
    "keys": ("keys of an experiment, or those with a word in their names", _list_keys),
    "schema": ("JSON Schema of experiments' or other files, for editors", _list_schema),
}
"""What can be listed: its description, and a function that prints the list or the item with a given name."""
_WRITTEN_OUT = {"environments": "envs", "algorithms": "algos"}
"""Kinds by longer names that a user may try."""

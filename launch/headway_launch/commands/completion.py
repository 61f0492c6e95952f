"""Completion of command lines in a shell, by argcomplete. Imports neither torch nor mlflow."""

import argparse
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import argcomplete
from argcomplete.completers import DirectoriesCompleter, FilesCompleter

from headway.config.experiment import ExperimentConfig, StoreConfig
from headway.config.json_schema import Schema, record_schema
from headway.registry import algo_entries, env_entries
from headway_launch.experiments.options import option_names, own_configs

_GROUPS = ("experiment", "env", "algo", "preset", "backend", "energy")


class CompletionParser(argparse.ArgumentParser):
    """Parser of unfinished command lines, in which options may stand between overrides."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # noqa: ANN401 - as argparse's
        """Parse all words except overrides, which argparse does not accept after an option."""
        return super().parse_known_args([word for word in args if not _is_override(word)], namespace)


def complete(parser: argparse.ArgumentParser) -> None:
    """Print the completions of the command line in the environment variable COMP_LINE, and exit."""
    _add_completers(parser)
    argcomplete.autocomplete(parser)


def _add_completers(parser: argparse.ArgumentParser) -> None:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for subparser in action.choices.values():
                _add_completers(subparser)
        elif completer := _COMPLETERS.get(str(action.metavar or action.dest)):
            action.completer = completer  # type: ignore[attr-defined]  # where argcomplete looks for it


def _is_override(word: str) -> bool:
    return "=" in word and not word.startswith("-")


def override_completions(words: Sequence[str], prefix: str) -> list[str]:
    """Return completions of an override, given the other words of the command.

    Nested keys are proposed once a letter has been typed; those of `algo` and `env.args` are those of the
    algorithm and environment among `words`, or of all. After a comma the next value of a sweep is completed.
    """
    key, is_value, value = prefix.partition("=")
    if is_value:
        known = _known_values(words, key)
        before = value[: value.rfind(",") + 1]
        return [f"{key}={before}{each}" for each in known]
    files = FilesCompleter(["yaml", "yml"])(prefix) if prefix else ()
    names = (name for name in _keys(words, prefix) if prefix or "." not in name)
    return [*(f"{name}=" for name in dict.fromkeys((*_GROUPS, *names))), *files]


def _known_values(words: Sequence[str], key: str) -> Iterable[str]:
    if key in _GROUPS:
        return option_names(key)
    if key == "start.run":
        return sorted(_of_runs("run_id")(argparse.Namespace(store=StoreConfig.root)))
    if key == "start.rule":
        known, chosen = env_entries(), dict(word.split("=", 1) for word in words if _is_override(word))
        named = [known[chosen["env"]]] if chosen.get("env") in known else known.values()
        return sorted({rule for entry in named for rule in entry.rules})
    return _values(_keys(words, key).get(key, {}))


def _keys(words: Sequence[str], prefix: str) -> dict[str, Schema]:
    """Return the schema of each full key; only those of `algo` and `env.args` that `prefix` may begin."""
    chosen = dict(word.split("=", 1) for word in words if _is_override(word))
    found = dict(_flat(record_schema(ExperimentConfig)))
    for group, path, entries in (("algo", "algo.", algo_entries), ("env", "env.args.", env_entries)):
        if prefix and (path.startswith(prefix) or prefix.startswith(path)):
            known: Mapping[str, Any] = entries()
            named = [known[chosen[group]]] if chosen.get(group) in known else known.values()
            found |= _flat(record_schema(*(entry.config for entry in named)), path)
    return found


def _flat(schema: Schema, path: str = "") -> Iterator[tuple[str, Schema]]:
    for name, inner in schema["properties"].items():
        if "properties" in inner:
            yield from _flat(inner, f"{path}{name}.")
        else:
            yield f"{path}{name}", inner


def _values(schema: Schema) -> list[str]:
    """Return the values of a schema, if there are few."""
    if "anyOf" in schema:
        return [value for inner in schema["anyOf"] for value in _values(inner)]
    by_type = {"boolean": ["true", "false"], "null": ["null"]}
    return [str(value) for value in schema.get("enum", by_type.get(str(schema.get("type")), ()))]


def _of_overrides(prefix: str, parsed_args: argparse.Namespace, **_: object) -> list[str]:
    own = getattr(parsed_args, "config_dir", None)
    with own_configs(own) if own else nullcontext():
        return override_completions(os.environ["COMP_LINE"].split()[:-1], prefix)


def _of_runs(column: str) -> Callable[..., set[str]]:
    """Return a completer with the values of a column of `headway runs`."""

    def values(parsed_args: argparse.Namespace, **_: object) -> set[str]:
        from headway.store.index import RunIndex

        root = Path(parsed_args.store)
        return {getattr(row, column) for row in RunIndex(root).rows()} if root.is_dir() else set()

    return values


def _of_kinds(**_: object) -> Iterable[str]:
    from headway_launch.commands.listing import KINDS

    return KINDS


def _of_names(parsed_args: argparse.Namespace, **_: object) -> Iterable[str]:
    """Return the names that `headway list KIND` takes."""
    group = {"rules": "env", "metrics": "env", "observations": "env", "searches": "search"}.get(
        parsed_args.kind
    )
    return option_names(group or str(parsed_args.kind).removesuffix("s"))


_COMPLETERS: Mapping[str, Callable[..., Iterable[str]]] = {
    **dict.fromkeys(("[FILE.yaml] KEY=VALUE", "KEY=VALUE", "env.args.KEY=VALUE"), _of_overrides),
    **dict.fromkeys(("RUN", "A", "B"), _of_runs("run_id")),
    **dict.fromkeys(("STUDY", "study"), _of_runs("study")),
    "SEARCH": lambda **_: option_names("search"),
    "KIND": _of_kinds,
    "NAME": _of_names,
    **dict.fromkeys(("FOLDER", "DIR", "store"), DirectoriesCompleter()),
}
"""Completer of each argument, by its name in the help or, without one, in the code."""

"""JSON Schema of the files of `configs/`, for editors."""

from collections.abc import Callable, Mapping

from headway.config.experiment import EnvConfig, ExperimentConfig
from headway.config.json_schema import Schema, record_schema
from headway.config.schema import literal_choices
from headway.registry import algo_entries, algo_entry, env_entries
from headway_launch.experiments.options import config_file, options
from headway_launch.experiments.search import Search
from headway_launch.experiments.search_space import Piece
from headway_launch.experiments.yaml_file import read_mapping

_SEEDS = {"type": ["integer", "string", "array"]}
_EXTERNAL = {"type": "string", "pattern": "[.:]"}
"""Environments by module, file or MODULE:ID."""


def file_schema(kind: str) -> Schema:
    """Return the schema of a kind of file, a key of `FILE_KINDS`."""
    own = FILE_KINDS[kind]()
    algos = {f"algo.{name}": _algo_schema(name) for name in algo_entries()}
    arguments = {f"args.{name}": record_schema(entry.config) for name, entry in env_entries().items()}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": f"Headway: {kind}",
        **own,
        "definitions": {**own.get("definitions", {}), **algos, **arguments},
    }


def _algo_schema(name: str) -> Schema:
    """Return the schema of an algorithm's keys, including keys that exist only with certain values of
    others."""
    entry = algo_entry(name)
    choices = [{key: value} for key, values in literal_choices(entry.config).items() for value in values]
    schema = record_schema(entry.config, *map(entry.record_for, choices))
    schema["properties"]["name"] = {"const": name}
    return schema


def _experiment_schema() -> Schema:
    groups = {group: list(known) for group, known in options().items() if group not in ("search", "space")}
    bases = {"enum": [*groups.pop("experiment"), "_self_"]}
    schema = record_schema(ExperimentConfig)
    keys = schema["properties"]
    keys["seed"] = {**_SEEDS, "description": keys["seed"]["description"]}
    keys["preset"] |= {"enum": groups["preset"]}
    keys["env"] = _env_schema()
    bare_words: Mapping[str, list[Schema]] = {  # YAML reads a bare `off` as false
        "env": [{"enum": groups["env"]}, _EXTERNAL],
        "algo": [{"enum": groups["algo"]}],
        "backend": [{"enum": groups["backend"]}],
        "energy": [{"enum": [*groups["energy"], False]}],
    }
    keys["algo"] = {"anyOf": [_ref("algo", name) for name in algo_entries()]}
    for group, words in bare_words.items():
        keys[group] = {"anyOf": [*words, keys[group]]}
    overrides = {f"override /{group}": {"enum": known} for group, known in groups.items()}
    choice = {"type": "object", "additionalProperties": False, "properties": overrides}
    keys["defaults"] = {
        "description": "Experiments to start from, and the options of groups.",
        "type": "array",
        "items": {"anyOf": [bases, choice]},
    }
    schema["allOf"] = [
        *(_if_chosen("env", "id", option, _arguments(name)) for option, name in _env_options().items()),
        *(_if_chosen("algo", "name", name, _ref("algo", name)) for name in algo_entries()),
    ]
    return schema


def _env_schema() -> Schema:
    """Return the schema of the mapping `env`: if the environment is known, so are its arguments."""
    schema = record_schema(EnvConfig)
    schema["allOf"] = [
        {"if": {"properties": {"id": {"const": name}}, "required": ["id"]}, "then": _arguments(name)}
        for name in env_entries()
    ]
    return schema


def _preset_schema() -> Schema:
    keys = {"$ref": "#/definitions/experiment"}
    values = {
        name: {"allOf": [keys, {"properties": {"algo": _ref("algo", name)}}]} for name in algo_entries()
    }
    bases = {"type": "array", "items": {"enum": [*options()["preset"], "_self_"]}}
    schema = {"type": "object", "additionalProperties": False, "properties": {"defaults": bases, **values}}
    return {**schema, "definitions": {"experiment": _experiment_schema()}}


def _if_chosen(group: str, key: str, option: str, then: Schema) -> Schema:
    """Return the schema of an experiment file: if `group` chooses `option`, its mapping must match `then`.

    `key` names the option within the mapping.
    """
    within = {"type": "object", "properties": {key: {"const": option}}, "required": [key]}
    override = f"override /{group}"
    listed = {"type": "object", "properties": {override: {"const": option}}, "required": [override]}
    chosen = [
        {"properties": {group: {"anyOf": [{"const": option}, within]}}, "required": [group]},
        {"properties": {"defaults": {"contains": listed}}, "required": ["defaults"]},
    ]
    return {
        "if": {"anyOf": chosen},
        "then": {"properties": {group: {"if": {"type": "object"}, "then": then}}},
    }


def _arguments(name: str) -> Schema:
    """Return the schema of a mapping `env` of a registered environment."""
    return {
        "properties": {
            "args": _ref("args", name),
            "training_args": {"anyOf": [_ref("args", name), {"type": "null"}]},
        }
    }


def _env_options() -> dict[str, str]:
    """Return the registered environment of each option of `env` that has one.

    Raises HeadwayError for a file that is not valid YAML.
    """
    known = env_entries()
    ids = {
        option: option if option in known else read_mapping(config_file("env", option)).get("id")
        for option in options()["env"]
    }
    return {option: str(name) for option, name in ids.items() if name in known}


def _ref(group: str, name: str) -> Schema:
    return {"$ref": f"#/definitions/{group}.{name}"}


FILE_KINDS: Mapping[str, Callable[[], Schema]] = {
    "experiment": _experiment_schema,
    "preset": _preset_schema,
    "env": _env_schema,
    "search": lambda: record_schema(Search),
    "space": lambda: record_schema(Piece),
}
"""Folders of `configs/` with the schema of their files, which may refer to definitions of `file_schema`."""

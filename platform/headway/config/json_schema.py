"""JSON Schema (draft 7) of the YAML that `headway.config.schema.build` takes, for editors."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import MISSING
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from headway.config.schema import field_docs, plain

Schema = dict[str, Any]

_NUMBER = r"^([-+]?\.?\d[\d_.]*([eE][-+]?\d+)?|\$\{.*\})$"
"""Text accepted in place of a number: interpolations, and forms such as 50_000 and 3e-4, which only some YAML
parsers read as numbers."""
_SCALARS: Mapping[Any, Schema] = {
    bool: {"type": "boolean"},
    int: {"type": ["integer", "string"], "pattern": _NUMBER},
    float: {"type": ["number", "string"], "pattern": _NUMBER},
    str: {"type": "string"},
    NoneType: {"type": "null"},
}


def record_schema(*record_classes: type) -> Schema:
    """Return the schema of a mapping with the keys of record classes; the first class that has a key
    describes it.

    No key is required, since other files may set it.
    """
    properties: dict[str, Schema] = {}
    for record_class in record_classes:
        hints, docs = get_type_hints(record_class), field_docs(record_class)
        for field in dataclasses.fields(record_class):
            described = {**hint_schema(hints[field.name]), **_default(field)}
            if doc := docs.get(field.name):
                described["description"] = doc
            properties.setdefault(field.name, described)
    return {"type": "object", "additionalProperties": False, "properties": properties}


def hint_schema(hint: object) -> Schema:
    """Return the schema of the values of an annotation."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return {"anyOf": [hint_schema(argument) for argument in arguments]}
    if origin is Literal:
        return {"enum": list(arguments)}
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return record_schema(hint)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": hint_schema(arguments[1])}
    if origin is tuple and Ellipsis not in arguments:
        size = len(arguments)
        items = [hint_schema(argument) for argument in arguments]
        return {"type": "array", "items": items, "minItems": size, "maxItems": size}
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return {"type": "array", "items": hint_schema(arguments[0])}
    return dict(_SCALARS.get(hint, {}))


def _default(field: "dataclasses.Field[Any]") -> Schema:
    """Return the schema's keyword `default`; empty if there is no default or if the keys of a nested record
    have their own."""
    default = field.default if field.default_factory is MISSING else field.default_factory()
    if default is MISSING or dataclasses.is_dataclass(default):
        return {}
    return {"default": plain(default)}

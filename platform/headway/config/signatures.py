"""Arguments of Python callables as configuration records, so that they are checked like all other keys."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, make_dataclass
from inspect import Parameter
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

_NAMED = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
_SCALARS = (bool, int, float, str, NoneType)


def takes_any_arguments(function: Callable[..., Any]) -> bool:
    """Return whether `function` accepts any keyword: it has `**kwargs`, or no signature at all."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return True
    return any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters)


def argument_record(function: Callable[..., Any], first: int = 0) -> type:
    """Return a frozen dataclass of the named arguments of `function` with their defaults.

    The first `first` arguments are left out, and those whose default YAML cannot represent. Annotations made
    of numbers, strings, booleans, None, and sequences and mappings of these are kept; any other annotation,
    or none, accepts any value. A line `NAME: ...` of the docstring, and further indented ones, describe one.
    """
    docs = inspect.cleandoc(function.__doc__ or "")
    fields: list[Any] = []
    for parameter in list(_signature(function).parameters.values())[first:]:
        if parameter.kind not in _NAMED or parameter.name.startswith("_"):
            continue
        hint = parameter.annotation if _is_plain_hint(parameter.annotation) else Any
        if parameter.default is Parameter.empty:
            made = field(kw_only=True, metadata=_described(docs, parameter.name))
        elif is_plain(parameter.default):
            made = _with_default(parameter.default, _described(docs, parameter.name))
        else:
            continue
        fields.append((parameter.name, hint, made))
    return make_dataclass("Arguments", fields, frozen=True)


def is_plain(value: object) -> bool:
    """Return whether YAML can represent `value`: numbers, strings, booleans, null, and lists and mappings."""
    if isinstance(value, _SCALARS):
        return True
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and is_plain(inner) for key, inner in value.items())
    return isinstance(value, tuple | list) and all(is_plain(inner) for inner in value)


def as_tuples(value: object) -> Any:  # noqa: ANN401 - any value
    """Return `value` with every list replaced by a tuple, at all depths: YAML writes tuples as lists."""
    return tuple(as_tuples(inner) for inner in value) if isinstance(value, tuple | list) else value


def _signature(function: Callable[..., Any]) -> inspect.Signature:
    try:
        return inspect.signature(function, eval_str=True)
    except Exception:  # an annotation with an undefined name
        return inspect.signature(function)


def _with_default(default: object, metadata: Mapping[str, str]) -> Any:  # noqa: ANN401 - `dataclasses` types fields loosely
    if isinstance(default, list | dict):
        return field(default_factory=lambda: default, kw_only=True, metadata=metadata)
    return field(default=default, kw_only=True, metadata=metadata)


def _described(docstring: str, name: str) -> dict[str, str]:
    """Return the metadata of a field (`schema.field_docs`) that a function's docstring describes."""
    form = rf"^([ \t]*)(?::param )?{name}(?: ?\(.*\))?:[ \t]+(\S.*(?:\n\1[ \t]+\S.*)*)"
    found = re.search(form, docstring, re.MULTILINE)
    return {"doc": " ".join(found[2].split())} if found else {}


def _is_plain_hint(hint: Any) -> bool:  # noqa: ANN401 - any annotation
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return all(_is_plain_hint(argument) for argument in arguments)
    if origin is Literal:
        return all(isinstance(argument, _SCALARS) for argument in arguments)
    if isinstance(origin, type) and issubclass(origin, Sequence | Mapping):
        return all(argument is Ellipsis or _is_plain_hint(argument) for argument in arguments)
    return hint is None or hint in _SCALARS

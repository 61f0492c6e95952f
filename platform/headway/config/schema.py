"""Mappings (from YAML and the command line) become frozen records, or one line that says what is wrong."""

import ast
import dataclasses
import difflib
import inspect
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import cache
from itertools import pairwise
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from headway.contracts.errors import HeadwayError

Record = TypeVar("Record")

_SPAN = re.compile(r"\s*(\d+)\s*\.\.\s*(\d+)\s*")
_RANGE = re.compile(r"\s*range\(\s*(\d+)\s*,\s*(\d+)\s*(?:,\s*(\d+)\s*)?\)\s*")
_NEGATIVE = re.compile(r"\s*\[?\s*-\d+\s*(\]|\.\.|,|$)")
_MOST_NAMES, _NEAREST_NAMES = 30, 8
"""Of more names than that so many are shown: a line must stay one that is read."""
_BEGINNING = 3
"""Letters of a name that stand for it."""
_SEED_FORMS = "write 7, 0,1,2, [0,1], 0..49 or range(0,50)"


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The one of `names` that `name` was probably meant to be, or None."""
    by_lower = {candidate.lower(): candidate for candidate in names}
    begun = [known for known in by_lower if known.startswith(name.lower())]
    if len(name) >= _BEGINNING and begun:
        return by_lower[min(begun, key=len)]
    found = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5)
    return by_lower[found[0]] if found else None


def suggestion(name: str, names: Iterable[str], prefix: str = "") -> str:
    """`did you mean PREFIXname? ` if one is near, and what there is: of many names the nearest."""
    known = sorted(names)
    near = nearest(name, known)
    start = f"did you mean {prefix}{near}? There" if near else "there"
    if len(known) > _MOST_NAMES:
        shown = difflib.get_close_matches(name, known, n=_NEAREST_NAMES, cutoff=0.0)
        return f"{start} is: {', '.join(shown)} and {len(known) - len(shown)} more"
    return f"{start} is: {', '.join(known) or 'nothing'}"


def build(record_class: type[Record], mapping: Mapping[str, Any], path: str = "", of: str = "") -> Record:
    """A `record_class` from nested mappings, lists and plain values.

    `path` is the full key of the mapping (for messages), `of` what its keys belong to. Records nest;
    whole floats (1e6) pass as int and ints as float, strings never as numbers, booleans never as ints.
    A record's `RENAMED`, a class variable, says of keys of earlier versions what they are now.
    Raises HeadwayError for an unknown or missing key, a value of the wrong type, one that the record's
    `__post_init__` refuses, and for `_target_` anywhere.
    """
    refuse_targets(mapping, path)
    checked = _as_dataclass(record_class)
    fields = {field.name: field for field in dataclasses.fields(checked) if field.init}
    for key in mapping:
        if key not in fields:
            if now := getattr(record_class, "RENAMED", {}).get(key):
                raise HeadwayError(f"{_join(path, str(key))}: '{key}' is now {now}")
            owner = of or path or "the experiment"
            raise HeadwayError(
                f"{_join(path, str(key))} is not a key of {owner}; "
                f"{suggestion(str(key), fields, f'{path}.' if path else '')}"
            )
    for name, field in fields.items():
        if name not in mapping and field.default is MISSING and field.default_factory is MISSING:
            raise HeadwayError(f"{_join(path, name)} is missing and has no default; give it a value")
    hints, docs = get_type_hints(record_class), _field_docs(checked)
    for key, value in mapping.items():
        _refuse_another(hints[key], value, _join(path, key), of, docs.get(key, ""))
    values = {key: _convert(hints[key], value, _join(path, key)) for key, value in mapping.items()}
    try:
        return record_class(**values)
    except ValueError as error:
        message = str(error)
        begins_with_key = message.split(" ", 1)[0].strip(":,").split(".")[0] in fields
        separator = "." if begins_with_key else ": "
        raise HeadwayError(f"{path}{separator}{message}" if path else message) from error


def refuse_targets(value: object, path: str = "") -> None:
    """Raise HeadwayError if `_target_` is a key anywhere in `value`: YAML names no Python objects."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if key == "_target_":
                raise HeadwayError(
                    f"{_join(path, '_target_')} is not allowed: configurations name no Python objects; "
                    "use a name that `headway list` shows"
                )
            refuse_targets(inner, _join(path, str(key)))
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        for index, inner in enumerate(value):
            refuse_targets(inner, f"{path}[{index}]")


def parse_seeds(value: object, path: str = "seed") -> tuple[int, ...]:
    """Seeds from `7`, `0,1,2`, `[0,1]`, `0..49` (inclusive) or `range(0,50)` (without its end).

    Raises HeadwayError for anything else.
    """
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return (value,)
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return tuple(seed for part in value for seed in parse_seeds(part, path))
    if isinstance(value, str):
        text = value.strip().removeprefix("[").removesuffix("]")
        if span := _SPAN.fullmatch(text):
            first, last = int(span[1]), int(span[2])
            if last < first:
                raise HeadwayError(f"{path}={value} ends before it begins; did you mean {last}..{first}?")
            return tuple(range(first, last + 1))
        if bounds := _RANGE.fullmatch(text):
            seeds = tuple(range(int(bounds[1]), int(bounds[2]), max(1, int(bounds[3] or 1))))
            if seeds:
                return seeds
        elif "," in text:
            return tuple(seed for part in text.split(",") for seed in parse_seeds(part, path))
        elif re.fullmatch(r"\d+", text):
            return (int(text),)
    if _NEGATIVE.match(str(value)):
        raise HeadwayError(f"{path}={value}: seeds must not be negative; {_SEED_FORMS}")
    raise HeadwayError(f"{path}={value} is not a list of seeds; {_SEED_FORMS}")


@dataclass(frozen=True)
class FieldDescription:
    """One key of a configuration record."""

    key: str
    """Full key, records within records joined by dots."""
    type: str
    default: str
    """As YAML would write it; `required` where there is none."""
    doc: str


def describe(record_class: type, path: str = "") -> tuple[FieldDescription, ...]:
    """Every key of a record and of the records in it, in order, with the docstring under each field."""
    hints = get_type_hints(record_class)
    docs = _field_docs(record_class)
    described: list[FieldDescription] = []
    for field in dataclasses.fields(_as_dataclass(record_class)):
        key, hint = _join(path, field.name), hints[field.name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            described.extend(describe(hint, key))
            continue
        doc = docs.get(field.name, "")
        described.append(FieldDescription(key, type_name(hint), _default_text(field), doc))
    return tuple(described)


def plain(value: object) -> Any:  # noqa: ANN401 - dictionaries, lists and plain values, nested
    """A record as dictionaries, lists and plain values, ready for YAML or JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(inner) for inner in value]
    return value


def type_name(hint: Any) -> str:  # noqa: ANN401 - any annotation
    """An annotation as a user would say it: `number or null`, `one of serial, process`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(type_name(argument) for argument in arguments)
    if origin is Literal:
        return "one of " + ", ".join(str(argument) for argument in arguments)
    if origin is tuple and Ellipsis not in arguments:
        return f"list of {len(arguments)} ({', '.join(type_name(argument) for argument in arguments)})"
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return "mapping"
    if isinstance(origin, type) and issubclass(origin, Sequence):
        inner = type_name(arguments[0])
        return f"list of {inner}s" if inner in ("number", "whole number") else f"list of {inner}"
    if hint is NoneType:
        return "null"
    names = {int: "whole number", float: "number", str: "text", bool: "true or false", Any: "anything"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def _refuse_another(hint: Any, value: object, key: str, of: str, doc: str) -> None:  # noqa: ANN401 - any annotation
    """A key that can have one value only belongs to what the record is: its docstring says what else to
    use."""
    allowed = get_args(hint)
    if get_origin(hint) is Literal and len(allowed) == 1 and value != allowed[0]:
        raise HeadwayError(f"{key}={_show(value)} is not possible, {of or 'it'} has {allowed[0]}: {doc}")


def _convert(hint: Any, value: Any, key: str) -> Any:  # noqa: ANN401 - any annotation, any value
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, UnionType):
        return _convert_union(hint, value, key)
    if origin is Literal:
        if any(value == allowed and type(value) is type(allowed) for allowed in arguments):
            return value
        allowed_names = [str(allowed) for allowed in arguments]
        raise HeadwayError(f"{key}={_show(value)} is not possible; {suggestion(str(value), allowed_names)}")
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        if isinstance(value, hint):
            return value
        if isinstance(value, Mapping):
            return build(hint, value, key)
        raise _wrong_type("mapping of keys", value, key)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, Mapping):
            raise _wrong_type(type_name(hint), value, key)
        inner = arguments[1] if len(arguments) == 2 else Any
        return {name: _convert(inner, item, f"{key}.{name}") for name, item in value.items()}
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return _convert_sequence(hint, value, key)
    return _convert_scalar(hint, value, key)


def _convert_scalar(hint: Any, value: Any, key: str) -> Any:  # noqa: ANN401 - any annotation, any value
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and is_number:
        return float(value)
    if hint is int and is_number and float(value).is_integer():
        return int(value)
    if hint is NoneType and value is None:
        return None
    if hint in (str, bool) and isinstance(value, hint):
        return value
    if isinstance(hint, type) and hint not in (int, float, str, bool) and isinstance(value, hint):
        return value
    raise _wrong_type(type_name(hint), value, key)


def _convert_union(hint: Any, value: Any, key: str) -> Any:  # noqa: ANN401 - any annotation, any value
    options = get_args(hint)
    if value is None and NoneType in options:
        return None
    problems: list[HeadwayError] = []
    for option in options:
        if option is NoneType:
            continue
        try:
            return _convert(option, value, key)
        except HeadwayError as problem:
            problems.append(problem)
    # With one thing it could have been, that thing's own complaint is the clearer one.
    raise problems[0] if len(problems) == 1 else _wrong_type(type_name(hint), value, key)


def _convert_sequence(hint: Any, value: Any, key: str) -> Any:  # noqa: ANN401 - any annotation, any value
    arguments = get_args(hint)
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise _wrong_type(type_name(hint), value, key)
    fixed = get_origin(hint) is tuple and Ellipsis not in arguments
    if fixed and len(value) != len(arguments):
        raise _wrong_type(type_name(hint), value, key)
    hints = arguments if fixed else (arguments[0],) * len(value)
    items = [
        _convert(item_hint, item, f"{key}[{index}]")
        for index, (item_hint, item) in enumerate(zip(hints, value, strict=True))
    ]
    return items if get_origin(hint) is list else tuple(items)


def _wrong_type(wanted: str, value: object, key: str) -> HeadwayError:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "text", NoneType: "null"}
    kind = kinds.get(type(value), "a mapping" if isinstance(value, Mapping) else "a list")
    hint = _how_to_write_a_number(value, wanted) if isinstance(value, str) else ""
    if wanted == "text" and kind in ("true or false", "a whole number", "a number"):
        hint = f"; write it in quotes, in a shell in two kinds: \"{key}='{_show(value)}'\""
    article = "a " if wanted.startswith(("number", "whole number", "list", "mapping")) else ""
    return HeadwayError(f"{key}={_show(value)} is {kind}, where {article}{wanted} is wanted{hint}")


def _how_to_write_a_number(text: str, wanted: str) -> str:
    if "number" not in wanted or wanted.startswith("list"):
        return ""
    try:
        float(text)
    except ValueError:
        example = "64" if "whole" in wanted else "3e-4"
        return f"; give a {'whole number' if 'whole' in wanted else 'number'}, such as {example}"
    return "; write it without quotes"


def _show(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value) if isinstance(value, str) else str(value)
    return textwrap.shorten(text, 60, placeholder="...")


def _default_text(field: "dataclasses.Field[Any]") -> str:
    if field.default is not MISSING:
        default = field.default
    elif field.default_factory is not MISSING:
        default = field.default_factory()
    else:
        return "required"
    if default is None or isinstance(default, bool):
        return _show(default)
    if isinstance(default, tuple | list):
        return "[" + ", ".join(str(item) for item in default) + "]"
    return str(default)


@cache
def _field_docs(record_class: type) -> Mapping[str, str]:
    """The string literal under each annotated field, of the class and its bases."""
    docs: dict[str, str] = {}
    for owner in reversed(record_class.__mro__[:-1]):
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(owner)))
        except (OSError, TypeError):  # made at run time: there is no source to read
            continue
        body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
        for statement, following in pairwise(body):
            if (
                isinstance(statement, ast.AnnAssign)
                and isinstance(statement.target, ast.Name)
                and isinstance(following, ast.Expr)
                and isinstance(following.value, ast.Constant)
                and isinstance(following.value.value, str)
            ):
                docs[statement.target.id] = " ".join(following.value.value.split())
    return docs


def _as_dataclass(record_class: type) -> Any:  # noqa: ANN401 - `dataclasses` types its own arguments loosely
    if not dataclasses.is_dataclass(record_class):
        raise TypeError(f"{record_class!r} is not a dataclass")
    return record_class


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key

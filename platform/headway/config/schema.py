"""Construction of frozen records from mappings (YAML, command line), with one-line errors."""

import ast
import dataclasses
import difflib
import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import cache
from itertools import pairwise
from math import isnan
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from headway.contracts.checks import shown
from headway.contracts.errors import HeadwayError, InvalidValueError, UnknownKeyError

Record = TypeVar("Record")

_SPAN = re.compile(r"\s*(\d+)\s*\.\.\s*(\d+)\s*")
_RANGE = re.compile(r"\s*range\(\s*(\d+)\s*,\s*(\d+)\s*(?:,\s*(\d+)\s*)?\)\s*")
_NEGATIVE = re.compile(r"\s*\[?\s*-\d+\s*(\]|\.\.|,|$)")
_MAX_NAMES, _NEAREST_NAMES = 30, 8
"""In messages, lists of more than `_MAX_NAMES` names are shortened to the `_NEAREST_NAMES` nearest, to fit on
a line."""
ALIASES = {"discount": "gamma", "learning_rate": "lr", "steps": "env_steps", "total_timesteps": "env_steps"}
"""Keys of other libraries and what they are called here, for suggestions."""
_MIN_PREFIX = 3
"""Length from which the beginning of a name is matched as an abbreviation."""
_MAX_INT = 2**63 - 1
"""Largest integer accepted: that of databases and of numpy's int64."""
_MAX_SEEDS = 10_000
"""Maximum number of seeds in a range."""
_SEED_FORMS = "write 7, 0,1,2, [0,1], 0..49 or range(0,50)"


def nearest(name: str, names: Iterable[str], cutoff: float = 0.5) -> str | None:
    """Return the one of `names` that `name` probably meant, or None.

    Case is ignored. A key of another library matches ours (`ALIASES`). An abbreviation of at least three
    letters matches the shortest name that starts with it; otherwise the closest name by edit similarity
    matches, if that is at least `cutoff`.
    """
    by_lower = {candidate.lower(): candidate for candidate in names}
    if (ours := ALIASES.get(name.lower())) in by_lower:
        return ours
    completions = [known for known in by_lower if known.startswith(name.lower())]
    if len(name) >= _MIN_PREFIX and completions:
        return by_lower[min(completions, key=len)]
    found = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=cutoff)
    return by_lower[found[0]] if found else None


def suggestion(name: str, names: Iterable[str], prefix: str = "", all_by: str = "") -> str:
    """Return the end of an error line: the nearest name, if any is similar, and the known names.

    `prefix` is put before the nearest name. If there are more than 30 names, only the nearest are listed, and
    `all_by` says how to list all.
    """
    known = sorted(names)
    near = nearest(name, known)
    start = f"did you mean {prefix}{near}? Available" if near else "available"
    if len(known) > _MAX_NAMES:
        shown = sorted(difflib.get_close_matches(name, known, n=_NEAREST_NAMES, cutoff=0.0))
        return f"{start}: {', '.join(shown)} and {len(known) - len(shown)} more{all_by}"
    return f"{start}: {', '.join(known) or 'none'}"


def build(
    record_class: type[Record],
    mapping: Mapping[str, Any],
    path: str = "",
    of: str = "",
    elsewhere: Callable[[str], str | None] | None = None,
) -> Record:
    """Return a `record_class` built from nested mappings, lists and plain values.

    For messages, `path` is the full key of the mapping, `of` names the owner of its keys, and `elsewhere`
    maps an unknown key to a remark on where it does exist, or to None. Records nest. Whole floats (1e6) are
    accepted as int and ints as float; strings are never accepted as numbers, nor booleans as ints.

    Raises HeadwayError for an unknown or missing key, a value of the wrong type, a value that the record's
    `__post_init__` rejects, and the key `_target_` anywhere.
    """
    refuse_targets(mapping, path)
    checked = _as_dataclass(record_class)
    fields = {field.name: field for field in dataclasses.fields(checked) if field.init}
    for key in mapping:
        if key not in fields:
            owner = of or path or "the experiment"
            known = elsewhere(str(key)) if elsewhere else None
            hint = known or suggestion(str(key), fields, f"{path}." if path else "")
            raise UnknownKeyError(_join(path, str(key)), owner, hint)
    for name, field in fields.items():
        if name not in mapping and not _has_default(field):
            raise HeadwayError(f"{_join(path, name)} is missing and has no default; give it a value")
    hints, docs = get_type_hints(record_class), field_docs(checked)
    for key, value in mapping.items():
        _check_single_choice(hints[key], value, _join(path, key), of, docs.get(key, ""))
    values = {
        key: _convert(hints[key], value, _join(path, key), _default_text(fields[key]))
        for key, value in mapping.items()
    }
    try:
        return record_class(**values)
    except InvalidValueError as error:
        raise HeadwayError(f"{_join(path, error.key)} {error.problem}") from error
    except ValueError as error:
        raise HeadwayError(f"{path}: {error}" if path else str(error)) from error


def refuse_targets(value: object, path: str = "") -> None:
    """Raise HeadwayError if `_target_` is a key anywhere in `value`: YAML must not name Python objects."""
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
    """Return the seeds written as `7`, `0,1,2`, `[0,1]`, `0..49` (inclusive) or `range(0,50)` (end excluded).

    Raises HeadwayError for any other form, a seed of more than 18 digits, and a range of more than 10,000.
    """
    if re.search(r"\d{19}", str(value)):
        raise HeadwayError(f"{path}={str(value)[:24]}... has more than 18 digits; give smaller seeds")
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
            return _few_seeds(range(first, last + 1), value, path)
        if bounds := _RANGE.fullmatch(text):
            seeds = range(int(bounds[1]), int(bounds[2]), max(1, int(bounds[3] or 1)))
            if seeds:
                return _few_seeds(seeds, value, path)
        elif "," in text:
            return tuple(seed for part in text.split(",") for seed in parse_seeds(part, path))
        elif re.fullmatch(r"\d+", text):
            return (int(text),)
    if _NEGATIVE.match(str(value)):
        raise HeadwayError(f"{path}={value}: seeds must not be negative; {_SEED_FORMS}")
    raise HeadwayError(f"{path}={value} is not a list of seeds; {_SEED_FORMS}")


def _few_seeds(seeds: range, value: object, path: str) -> tuple[int, ...]:
    if len(seeds) > _MAX_SEEDS:
        raise HeadwayError(f"{path}={value} is {len(seeds):,} seeds; give at most {_MAX_SEEDS:,}")
    return tuple(seeds)


@dataclass(frozen=True)
class FieldDescription:
    """Description of one configuration key."""

    key: str
    """Full key; nested records are joined by dots."""
    type: str
    """Type in words, as `type_name` returns it."""
    default: str
    """Default as YAML writes it; `required` if there is none."""
    doc: str
    """Docstring under the field, on one line; empty if there is none."""


def describe(record_class: type, path: str = "") -> tuple[FieldDescription, ...]:
    """Return a description of every key of a record class, in order, nested records included."""
    hints = get_type_hints(record_class)
    docs = field_docs(record_class)
    described: list[FieldDescription] = []
    for field in dataclasses.fields(_as_dataclass(record_class)):
        key, hint = _join(path, field.name), hints[field.name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            described.extend(describe(hint, key))
            continue
        doc = docs.get(field.name, "")
        described.append(FieldDescription(key, type_name(hint), _default_text(field), doc))
    return tuple(described)


def literal_choices(record_class: type) -> dict[str, tuple[Any, ...]]:
    """Return the possible values of each key whose type is a `Literal`, by key."""
    hints = get_type_hints(record_class)
    names = [field.name for field in dataclasses.fields(_as_dataclass(record_class))]
    return {name: get_args(hints[name]) for name in names if get_origin(hints[name]) is Literal}


def plain(value: object) -> Any:  # noqa: ANN401 - dictionaries, lists and plain values, nested
    """Return a record as dictionaries, lists and plain values, ready for YAML or JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(inner) for inner in value]
    return value


def type_name(hint: Any) -> str:  # noqa: ANN401 - any annotation
    """Return an annotation in words: `number or null`, `one of serial, process`."""
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
        if arguments[0] is Any:
            return "list"
        return f"list of {inner}s" if inner in ("number", "whole number", "mapping") else f"list of {inner}"
    if hint is NoneType:
        return "null"
    if dataclasses.is_dataclass(hint):
        return "mapping"
    names = {int: "whole number", float: "number", str: "text", bool: "true or false", Any: "anything"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def _check_single_choice(hint: Any, value: object, key: str, of: str, doc: str) -> None:  # noqa: ANN401 - any annotation
    """Raise HeadwayError if a key that allows a single value is set to another one.

    The message ends with the key's docstring, which names the record to use instead.
    """
    allowed = get_args(hint)
    if get_origin(hint) is Literal and len(allowed) == 1 and value != allowed[0]:
        fixed = f"{of or 'it'} has {key.rpartition('.')[2]}={allowed[0]}"
        raise HeadwayError(f"{key}={shown(value)} is not possible: {fixed}. {doc}")


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not MISSING or field.default_factory is not MISSING


def _convert(hint: Any, value: Any, key: str, default: str = "") -> Any:  # noqa: ANN401 - any annotation, any value
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, UnionType):
        return _convert_union(hint, value, key, default)
    if origin is Literal:
        if any(value == allowed and type(value) is type(allowed) for allowed in arguments):
            return value
        allowed_names = [str(allowed) for allowed in arguments]
        raise HeadwayError(f"{key}={shown(value)} is not possible; {suggestion(str(value), allowed_names)}")
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        if isinstance(value, hint):
            return value
        # null for a group of keys clears what a file sets: each key has its default.
        if value is None and all(_has_default(field) for field in dataclasses.fields(hint)):
            return hint()
        if isinstance(value, Mapping):
            return build(hint, value, key)
        raise _wrong_type("mapping of keys", value, key)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if value is None:
            return {}
        if not isinstance(value, Mapping):
            raise _wrong_type(type_name(hint), value, key)
        inner = arguments[1] if len(arguments) == 2 else Any
        if numbers := [name for name in value if not isinstance(name, str)]:
            raise HeadwayError(f"{key} has the key {numbers[0]}, which is not text; write it in quotes")
        return {name: _convert(inner, item, f"{key}.{name}") for name, item in value.items()}
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return _convert_sequence(hint, value, key)
    return _convert_scalar(hint, value, key, default)


def _convert_scalar(hint: Any, value: Any, key: str, default: str) -> Any:  # noqa: ANN401 - any annotation, any value
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and isinstance(value, int) and abs(value) > _MAX_INT:
        raise HeadwayError(f"{key} is a whole number beyond 2^63; give a smaller one")
    if hint is float and is_number:
        if isnan(value):
            raise HeadwayError(f"{key} must be a number, not {value}")
        return float(value)
    if hint is int and is_number and abs(value) <= _MAX_INT and float(value).is_integer():
        return int(value)
    if hint is NoneType and value is None:
        return None
    if hint in (str, bool) and isinstance(value, hint):
        return value
    if isinstance(hint, type) and hint not in (int, float, str, bool) and isinstance(value, hint):
        return value
    raise _wrong_type(type_name(hint), value, key, default)


def _convert_union(hint: Any, value: Any, key: str, default: str) -> Any:  # noqa: ANN401 - any annotation, any value
    options = get_args(hint)
    if value is None and NoneType in options:
        return None
    problems: list[HeadwayError] = []
    for option in options:
        if option is NoneType:
            continue
        try:
            return _convert(option, value, key, default)
        except HeadwayError as problem:
            problems.append(problem)
    # If only one type was possible, its own message is clearer than that of the union.
    raise problems[0] if len(problems) == 1 else _wrong_type(type_name(hint), value, key, default)


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


def _wrong_type(wanted: str, value: object, key: str, default: str = "") -> HeadwayError:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "text", NoneType: "null"}
    kind = kinds.get(type(value), "a mapping" if isinstance(value, Mapping) else "a list")
    hint = _number_hint(value, wanted, default) if isinstance(value, str) else ""
    if wanted == "text" and kind in ("true or false", "a whole number", "a number"):
        hint = f"; write it in quotes (in a shell, in two pairs): \"{key}='{shown(value)}'\""
    word = isinstance(value, str) and value.isidentifier()
    if wanted.startswith("list") and (word or kind in ("a whole number", "a number")):
        hint = f"; write {key}=[{value}]"
    article = "a " if wanted.startswith(("number", "whole number", "list", "mapping")) else ""
    return HeadwayError(f"{key}={shown(value)} is {kind}, where {article}{wanted} is expected{hint}")


def _number_hint(text: str, wanted: str, default: str) -> str:
    if "number" not in wanted or wanted.startswith("list"):
        return ""
    try:
        float(text)
    except ValueError:
        example = default if default[:1].isdigit() else "64" if "whole" in wanted else "3e-4"
        return f"; give a {'whole number' if 'whole' in wanted else 'number'}, such as {example}"
    return "; write it without quotes"


def _default_text(field: "dataclasses.Field[Any]") -> str:
    if field.default is not MISSING:
        default = field.default
    elif field.default_factory is not MISSING:
        default = field.default_factory()
    else:
        return "required"
    if default is None or isinstance(default, bool):
        return shown(default)
    if isinstance(default, tuple | list):
        return "[" + ", ".join(str(item) for item in default) + "]"
    return str(default)


@cache
def field_docs(record_class: type) -> Mapping[str, str]:
    """Return the string literal under each annotated field of a class and its bases, on one line each.

    Fields of classes made at run time have it as `doc` in their metadata.
    """
    docs: dict[str, str] = {}
    for owner in reversed(record_class.__mro__[:-1]):
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(owner)))
        except (OSError, TypeError):  # classes made at run time have no source
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
    made = {
        field.name: field.metadata["doc"]
        for field in dataclasses.fields(record_class)
        if "doc" in field.metadata
    }
    return docs | made


def _as_dataclass(record_class: type) -> Any:  # noqa: ANN401 - `dataclasses` types its own arguments loosely
    if not dataclasses.is_dataclass(record_class):
        raise TypeError(f"{record_class!r} is not a dataclass")
    return record_class


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key

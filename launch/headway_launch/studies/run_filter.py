"""Conditions, sort keys and columns of `headway runs` and `headway plot`; SQLite evaluates conditions.

`final_reward>300 and (algo.lr<1e-3 or seed in (1, 2))` is an SQL expression whose columns are the fields of
the index and the runs' parameters by their dotted names.
"""

import re
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import astuple, fields
from functools import cached_property
from math import isfinite
from pathlib import Path

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway.store.index import RunRow
from headway.store.run_folder import RunRecord

_TOKEN = re.compile(
    r"""'[^']*'
    | "(?P<quoted>[^"]*)"
    | (?P<equals>==|!=|<>|(?<![<>])=)\s*(?P<text>\[[^]]*\]|[^\s'"(),]+)
    | (?P<ordered>[a-z_][\w./]*)(?P<bound>\s*[<>]=?\s*[-+.\d][\d.]*(?:e[-+]?\d+)?)
    | [\d.]+(?:e[-+]?\d+)?
    | (?P<word>[a-z_][\w./]*)""",
    re.VERBOSE | re.IGNORECASE,
)
_NAME = re.compile(r"[-+]?0[0-9]|.*_")
"""Start of text that Python would accept as a number but never writes as one, such as `007` or `2_000`."""
_COMPARISON = re.compile(r"[<>=]|\b(in|like|glob|between|is)\b", re.IGNORECASE)
_SORT_KEY = re.compile(r"(?P<field>\S+)(?P<direction>\s+(asc|desc))?", re.IGNORECASE)
_KEYWORDS = {"and", "or", "not", "in", "is", "null", "between", "like", "glob"}
_FORMS = (
    "write FIELD<VALUE, <=, >, >=, = or !=, joined by `and` or `or`: --where 'final_reward>300 and seed<10'"
)
_FIELDS = {item.name: item.type in (int, float, float | None) for item in fields(RunRow)}
"""The fields of the index, and whether their values are numbers."""


def filter_runs(rows: Sequence[RunRow], conditions: Sequence[str], sort: str = "") -> list[RunRow]:
    """Return the runs that meet all `conditions`, ordered by `sort`.

    A condition does not hold for a run whose value is unknown. A word after `=` or `!=` is text and needs no
    quotes; `true`, `null` and lists in parameters are written as on a command line. `sort`: comma-separated
    fields, each optionally followed by ` desc`; unknown values come last.

    Raises HeadwayError for an unknown field or parameter and for an invalid expression.
    """
    columns = _Columns(rows)
    where = {text: _expression(text, columns) for text in conditions}
    order = [_sort_key(key.strip(), columns) for key in sort.split(",") if key.strip()]
    with closing(sqlite3.connect(":memory:")) as database:
        columns.write(database)
        for text, expression in where.items():
            try:
                database.execute(f"SELECT 1 FROM runs WHERE {expression} LIMIT 0")
            except sqlite3.Error as error:
                raise HeadwayError(f"--where {text!r} is not a condition ({error}); {_FORMS}") from error
        chosen = " AND ".join(f"({expression})" for expression in where.values()) or "TRUE"
        found = database.execute(f"SELECT row FROM runs WHERE {chosen} ORDER BY {', '.join([*order, 'row'])}")
        return [rows[row] for (row,) in found]


def column_names(rows: Sequence[RunRow], columns: str) -> list[str]:
    """Return the fields and parameters that `columns` lists, separated by commas.

    Raises HeadwayError for an unknown one.
    """
    known = _Columns(rows)
    names = [name.strip() for name in columns.split(",")]
    for name in names:
        known.named("--columns", name)
    return names


def parameters_of(row: RunRow) -> dict[str, str | int | float]:
    """Return a run's parameters by dotted name, numbers as such; none if its record cannot be read."""
    return {name: as_number(text) for name, text in _texts(row).items()}


def as_number(text: str) -> str | int | float:
    """Return the number that a text stands for if it is finite, else the text; `007` and `2024_01`
    stay text."""
    if _NAME.match(text):
        return text
    for kind in (int, float):
        with suppress(ValueError, OverflowError):
            return value if isfinite(value := kind(text)) else text
    return text


class _Columns:
    """The columns that conditions and sort keys name: fields of the index and parameters of the runs."""

    def __init__(self, rows: Sequence[RunRow]) -> None:
        self._rows = rows
        self._named: dict[str, None] = {}

    def named(self, option: str, name: str) -> str:
        """Return a column's name in SQL. Raises HeadwayError if neither a field nor a run's parameter."""
        if name in _FIELDS:
            return f'"{name}"'  # the records of the runs need not be read
        known = {key for parameters in self._parameters for key in parameters}
        if "." not in name:
            near = f"{suggestion(name, _FIELDS)}; or a parameter, such as algo.lr"
            if full_names := sorted(key for key in known if key.endswith(f".{name}")):
                near = f"did you mean {' or '.join(full_names)}?"
            raise HeadwayError(f"{option}: a run has no field {name!r}; {near}")
        if name not in known and self._rows:
            raise HeadwayError(f"{option}: no run has the parameter {name!r}; {suggestion(name, known)}")
        self._named[name] = None
        return f'"{name}"'

    def text_of(self, name: str) -> str | None:
        """Return a value of the column that is not a number; None if there is none."""
        if "." not in name:
            return None if _FIELDS[name] else next((str(getattr(row, name)) for row in self._rows), "text")
        values = (parameters[name] for parameters in self._parameters if name in parameters)
        return next((value for value in values if not _is_number(value)), None)

    def write(self, database: sqlite3.Connection) -> None:
        """Write the table `runs`: `row`, the position of a run, the fields and the named parameters.

        Text that is a number becomes one in a parameter's column.
        """
        names = [*_FIELDS, *self._named]
        types = ["NUMERIC" if _FIELDS.get(name, True) else "TEXT" for name in names]
        columns = (f'"{name}" {kind}' for name, kind in zip(names, types, strict=True))
        database.execute(f"CREATE TABLE runs (row, {', '.join(columns)})")
        insert = f"INSERT INTO runs VALUES (?{', ?' * len(names)})"
        for position, row in enumerate(self._rows):
            parameters = [self._parameters[position].get(name) for name in self._named]
            database.execute(insert, (position, *astuple(row), *parameters))

    @cached_property
    def _parameters(self) -> list[Mapping[str, str]]:
        return [_texts(row) for row in self._rows]


def _texts(row: RunRow) -> Mapping[str, str]:
    """Return a run's parameters as its record has them; none if that cannot be read, as the index tells."""
    try:
        return RunRecord.read(Path(row.directory)).parameters
    except HeadwayError:
        return {}


def _expression(text: str, columns: _Columns) -> str:
    """Return a condition in SQL: columns quoted, and the words after `=` and `!=` as text."""

    field = ""

    def in_sql(token: re.Match[str]) -> str:
        nonlocal field
        if token["quoted"] is not None:
            return _quoted(token["quoted"])
        if (value := token["text"]) is not None:
            if not _FIELDS.get(field, True):  # such as a study with the name `true` or `007`
                return token["equals"] + _quoted(value)
            return token["equals"] + (value if _is_number(value) else _quoted(_stored(value)))
        if (name := token["ordered"]) is not None:
            column = columns.named("--where", name)
            if (other := columns.text_of(name)) is not None:
                raise HeadwayError(f"--where: {token[0]} orders text ({other}); use = or !=")
            return column + token["bound"]
        if (word := token["word"]) is not None and word.lower() not in _KEYWORDS:
            field = word
            return columns.named("--where", word)
        return token[0]

    if not _COMPARISON.search(text):
        raise HeadwayError(f"--where {text!r} is not a condition; {_FORMS}")
    return _TOKEN.sub(in_sql, text)


def _stored(text: str) -> str:
    """Return a command line's value in the form of stored parameters, Python's: `True` for `true`."""
    if not text.startswith("[") and text.lower() not in ("true", "false", "null"):
        return text
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    with suppress(HydraException):
        return str(OverridesParser.create().parse_override(f"key={text}").value())
    return text


def _sort_key(key: str, columns: _Columns) -> str:
    found = _SORT_KEY.fullmatch(key)
    if found is None:
        raise HeadwayError(f"--sort {key!r}: write FIELD, FIELD asc or FIELD desc, separated by commas")
    return f"{columns.named('--sort', found['field'])}{found['direction'] or ''} NULLS LAST"


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _is_number(text: str) -> bool:
    return not isinstance(as_number(text), str)

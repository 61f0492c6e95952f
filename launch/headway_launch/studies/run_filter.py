"""Conditions and sort keys on the run index: `final_reward>300`, `final_reward desc, seed`."""

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from headway.store.index import RunRow

Value = str | int | float | None

_CONDITION = re.compile(r"\s*(?P<field>[\w./]+)\s*(?P<sign><=|>=|!=|==|=|<|>)\s*(?P<value>.*?)\s*")
_AND = re.compile(r"\s+and\s+|\s*&&\s*")
_OR = re.compile(r"\s+or\s+|\|\|")
_SIGNS: dict[str, Callable[[float | str, float | str], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
    "=": operator.eq, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip
_FORMS = "write FIELD<VALUE, <=, >, >=, = or !=, such as --where 'final_reward>300 and seed<10'"


@dataclass(frozen=True)
class Condition:
    """A comparison of a field of the index, or of a parameter by its dotted name, with a value."""

    field: str
    sign: str
    value: str

    def holds(self, row: "RunRow") -> bool:
        """Return whether a run meets the condition; false if its value is unknown.

        Raises HeadwayError if text is ordered against a number.
        """
        known = value_of(row, self.field)
        if known is None:
            return False
        number, own = _number(self.value), _number(str(known))
        if number is not None and own is not None:
            return _SIGNS[self.sign](own, number)
        if self.sign not in ("=", "==", "!="):
            condition = f"{self.field}{self.sign}{self.value}"
            if own is not None:
                raise HeadwayError(
                    f"--where: {condition} compares a number, but {self.value!r} is not one; {_FORMS}"
                )
            raise HeadwayError(f"--where: {condition} orders text ({known}); use = or !=")
        return _SIGNS[self.sign](str(known), self.value)


def parse_conditions(texts: Sequence[str]) -> list[Condition]:
    """Return the conditions of `--where`, all of which must hold. Raises HeadwayError for an invalid one."""
    conditions = []
    for text in (part for whole in texts for part in _AND.split(whole)):
        if _OR.search(text):
            raise HeadwayError(
                f"--where {text!r}: conditions are joined by 'and' only; list runs once for each"
            )
        found = _CONDITION.fullmatch(text)
        if found is None or not found["value"]:
            raise HeadwayError(f"--where {text!r} is not a condition; {_FORMS}")
        _require_field("--where", found["field"])
        conditions.append(Condition(found["field"], found["sign"], found["value"].strip("'\"")))
    return conditions


def require_known(rows: Sequence["RunRow"], conditions: Sequence[Condition], keys: str) -> None:
    """Raise HeadwayError for a parameter in the conditions, or in the sort `keys`, that no run has."""
    named = [("--where", condition.field) for condition in conditions]
    named += [("--sort", key.split()[0]) for key in keys.split(",") if key.strip()]
    for option, field in named:
        if "." in field and rows and all(value_of(row, field) is None for row in rows):
            known = {name for row in rows for name in _parameters(row.directory)}
            raise HeadwayError(f"{option}: no run has the parameter {field!r}; {suggestion(field, known)}")


def in_order(rows: Sequence["RunRow"], keys: str) -> list["RunRow"]:
    """Return the runs sorted by comma-separated fields, each optionally followed by ` desc`.

    Runs with an unknown value come last. Raises HeadwayError for an unknown field.
    """
    ordered = list(rows)
    for key in reversed([key.strip() for key in keys.split(",") if key.strip()]):
        field, _, direction = key.partition(" ")
        descending = direction.strip().lower() == "desc"
        if not descending and direction.strip().lower() not in ("", "asc"):
            raise HeadwayError(f"--sort {key!r}: write FIELD, FIELD asc or FIELD desc, separated by commas")
        _require_field("--sort", field)
        known = [row for row in ordered if value_of(row, field) is not None]
        unknown = [row for row in ordered if value_of(row, field) is None]
        known.sort(key=lambda row: _sort_key(value_of(row, field)), reverse=descending)
        ordered = known + unknown
    return ordered


def value_of(row: "RunRow", field: str) -> Value:
    """Return a column of a run or, if `field` has a dot, one of its parameters; None if unknown or NaN."""
    if "." not in field:
        value: Value = getattr(row, field)
        return None if isinstance(value, float) and math.isnan(value) else value
    return _parameters(row.directory).get(field)


@cache
def _parameters(directory: str) -> Mapping[str, str]:
    """Return the parameters of the run in a folder, cached because each condition and sort key reads them."""
    from headway.store.run_folder import RunRecord

    return RunRecord.read(Path(directory)).parameters


def _require_field(option: str, field: str) -> None:
    from headway.store.index import RunRow

    known = [item.name for item in fields(RunRow)]
    if "." not in field and field not in known:
        hint = suggestion(field, known)
        raise HeadwayError(f"{option}: a run has no field {field!r}; {hint}; or a parameter, such as algo.lr")


def _sort_key(value: Value) -> tuple[int, float, str]:
    """Return the sort key of a value: numbers by size, then text in alphabetical order."""
    number = float(value) if isinstance(value, int | float) else _number(str(value))
    return (0, number, "") if number is not None else (1, 0.0, str(value))


def _number(text: str) -> float | None:
    """Return the number in a text; None if it is not a number."""
    try:
        return float(text)
    except ValueError:
        return None

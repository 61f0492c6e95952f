"""JSON Schema of annotations and records."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from jsonschema import Draft7Validator

from headway.config.json_schema import hint_schema, record_schema


@dataclass(frozen=True)
class _Inner:
    size: int = 3
    """Number of rows."""


@dataclass(frozen=True)
class _Outer:
    required: float
    inner: _Inner = field(default_factory=_Inner)
    names: tuple[str, ...] = ("a", "b")


@pytest.mark.parametrize(
    ("hint", "accepted", "refused"),
    [
        (int, [3, "400_000", "1e6", "${env_steps}"], [3.5, "three", True, None]),
        (float, [0.5, 3, "3e-4"], ["x", None, [1.0]]),
        (int | None, [3, None], ["x"]),
        (Literal["a", "b"], ["a"], ["c", 1]),
        (tuple[float, str], [[1.0, "x"]], [[1.0], ["x", 1.0], [1.0, "x", "y"]]),
        (tuple[int, ...], [[], [1, 2]], [["x"], 1]),
        (Mapping[str, bool], [{"a": True}], [{"a": 1}, [True]]),
        (_Inner, [{}, {"size": 1}], [{"sice": 1}, 1]),
        (Any, [None, [1], {"a": 1}], []),
    ],
    ids=str,
)
def test_values_are_taken_as_by_records(hint: object, accepted: list[object], refused: list[object]) -> None:
    schema = Draft7Validator(hint_schema(hint))
    assert [value for value in accepted if not schema.is_valid(value)] == []
    assert [value for value in refused if schema.is_valid(value)] == []


def test_a_key_has_its_default_and_description_and_none_is_required() -> None:
    keys = record_schema(_Outer)["properties"]
    assert keys["names"]["default"] == ["a", "b"]
    assert "default" not in keys["required"]
    assert "default" not in keys["inner"]
    size = keys["inner"]["properties"]["size"]
    assert (size["default"], size["description"]) == (3, "Number of rows.")
    assert Draft7Validator(record_schema(_Outer)).is_valid({})

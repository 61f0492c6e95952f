"""Search spaces: dimensions, the pieces in configs/space, and the overrides of a candidate."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import e
from typing import Any

from headway.config.schema import build, suggestion
from headway.contracts.checks import require_finite, require_key, require_value
from headway.contracts.errors import HeadwayError
from headway.registry import algo_entries
from headway_launch.experiments.options import config_file, options
from headway_launch.experiments.override_words import written
from headway_launch.experiments.yaml_file import read_mapping

_SEARCHED = ("algo", "rollout", "start", "env.training_args", "env.wrappers")
"""Keys, with those below them, that candidates may differ in: other keys would change what is scored."""
_FORMS = "write {low: 1.0e-4, high: 1.0e-2, log: true}, [1, 4, 10], or {NAME: [KEY=VALUE, ...], ...}"

Value = float | int | str
"""Value of a dimension in a candidate: a number of a range, or the name of a choice."""


@dataclass(frozen=True)
class Range:
    """Numbers between two bounds, both included: whole ones if `low`, `high` and `step` are."""

    low: float
    high: float
    log: bool = False
    step: float | None = None

    def __post_init__(self) -> None:
        require_finite(self)
        require_value(self, "low", self.low < self.high, f"must be below high={self.high:g}")
        step, span = self.step, self.high - self.low
        only = not self.log or (self.low > 0 and step is None)
        require_key(only, "log", "needs low above 0 and no step")
        fits = step is None or (step > 0 and abs(span / step - round(span / step)) < 1e-9)
        require_key(fits, "step", f"of {step} does not lead from low to high")

    @property
    def whole(self) -> bool:
        """Whether the numbers are whole."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def ends(self) -> tuple[Value, ...]:
        """The bounds, and of fractions one between them: a key of whole numbers refuses it."""
        low, high = self.low, self.high
        return (low, high) if self.whole else (low, high, low + (self.step or (high - low) / e))

    def grid(self, key: str) -> tuple[Value, ...]:
        """Return the numbers of a grid. Raises HeadwayError for a range without steps."""
        step = self.step or (1 if self.whole and not self.log else None)
        if step is None:
            raise HeadwayError(f"space: {key} is a range without step; for a grid list its values")
        count = round((self.high - self.low) / step) + 1
        return tuple(self.low + place * step for place in range(count))


@dataclass(frozen=True)
class Choices:
    """A list of values, or named alternatives."""

    choices: Mapping[str, Any]
    """Each value as text -> the value, or name -> its overrides."""
    named: bool

    @property
    def ends(self) -> tuple[Value, ...]:
        """All names."""
        return tuple(self.choices)

    def grid(self, key: str) -> tuple[Value, ...]:
        """Return all names."""
        return tuple(self.choices)


Dimension = Range | Choices
Space = Mapping[str, Dimension]
"""Key -> its dimension; of named choices any name."""


@dataclass(frozen=True)
class Piece:
    """Contents of a file in configs/space: the dimensions of one piece of algorithms."""

    algorithms: tuple[str, ...]
    """Algorithms that have this piece."""
    space: Mapping[str, Any] = field(default_factory=dict)
    """Key -> its dimension: `{low: 1.0e-4, high: 1.0e-2, log: true}`, a list of values, or named lists of
    overrides."""


def read_piece(name: str) -> Piece:
    """Return a piece of the group `space`. Raises HeadwayError if it does not exist or is not valid."""
    known = options().get("space", ())
    if name not in known:
        raise HeadwayError(f"there is no space {name!r}; {suggestion(name, known)}")
    piece = build(Piece, read_mapping(config_file("space", name)), f"space/{name}")
    for algorithm in piece.algorithms:
        if algorithm not in algo_entries():
            raise HeadwayError(
                f"space/{name}: no algorithm {algorithm!r}; {suggestion(algorithm, algo_entries())}"
            )
    return piece


def dimensions(space: Mapping[str, Any], path: str) -> dict[str, Dimension]:
    """Return the dimensions of a mapping in YAML. Raises HeadwayError for one that is not valid."""
    return {key: _dimension(key, value, f"{path}.{key}") for key, value in space.items()}


def _dimension(key: str, value: object, path: str) -> Dimension:
    if isinstance(value, Mapping) and {"low", "high"} & set(value):
        _require_searched(key, path)
        return _range(value, path)
    if isinstance(value, Mapping) and value and all(isinstance(words, list) for words in value.values()):
        choices = {str(name): tuple(map(str, words)) for name, words in value.items()}
        for name, words in choices.items():
            for word in words:
                _require_searched(word.partition("=")[0], f"{path}.{name}: {word}")
        return Choices(choices, named=True)
    if isinstance(value, list) and value:
        _require_searched(key, path)
        texts = [written(each) for each in value]
        if len(set(texts)) < len(texts):
            raise HeadwayError(f"{path} lists a value twice")
        return Choices(dict(zip(texts, value, strict=True)), named=False)
    raise HeadwayError(f"{path} is empty or no dimension; {_FORMS}")


def _range(value: Mapping[str, Any], path: str) -> Range:
    found = build(Range, value, path)
    if not all(isinstance(value.get(name) or 0, int) for name in ("low", "high", "step")):
        return found
    step = None if found.step is None else int(found.step)
    return replace(found, low=int(found.low), high=int(found.high), step=step)


def _require_searched(key: str, path: str) -> None:
    if not is_searched(key):
        raise HeadwayError(f"{path} cannot be searched: candidates differ in keys of {', '.join(_SEARCHED)}")


def is_searched(key: str) -> bool:
    """Return whether candidates may differ in a key."""
    return any(key == known or key.startswith(f"{known}.") for known in _SEARCHED)


def _alternatives(space: Space) -> dict[str, Choices]:
    """Return the dimensions whose choices are named lists of overrides."""
    return {
        key: dimension
        for key, dimension in space.items()
        if isinstance(dimension, Choices) and dimension.named
    }


def names_of_choices(space: Space, values: Mapping[str, Value]) -> list[str]:
    """Return the names that the search file gives to a candidate's choices."""
    return [str(values[key]) for key in _alternatives(space)]


def chosen_overrides(space: Space, values: Mapping[str, Value]) -> tuple[str, ...]:
    """Return the overrides of the named alternatives of a candidate."""
    named = _alternatives(space).items()
    return tuple(word for key, dimension in named for word in dimension.choices[str(values[key])])


def candidate_settings(space: Space, values: Mapping[str, Value]) -> dict[str, Any]:
    """Return the keys and values of a candidate, without those of named alternatives."""
    return {
        key: values[key] if isinstance(dimension, Range) else dimension.choices[str(values[key])]
        for key, dimension in space.items()
        if key not in _alternatives(space)
    }


def candidate_overrides(space: Space, values: Mapping[str, Value]) -> tuple[str, ...]:
    """Return the overrides that describe a candidate."""
    settings = candidate_settings(space, values)
    return (*chosen_overrides(space, values), *(f"{key}={written(value)}" for key, value in settings.items()))


def corners(space: Space) -> list[dict[str, Value]]:
    """Return candidates among which all of `ends` of each dimension occur."""
    ends = {key: dimension.ends for key, dimension in space.items()}
    return [
        {key: known[place % len(known)] for key, known in ends.items()}
        for place in range(max(map(len, ends.values())))
    ]


def grid(space: Space) -> dict[str, tuple[Value, ...]]:
    """Return the values of each dimension of a grid. Raises HeadwayError for a range without steps."""
    return {key: dimension.grid(key) for key, dimension in space.items()}

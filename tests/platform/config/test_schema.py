from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest

from headway.config.experiment import BackendConfig, ExperimentConfig
from headway.config.schema import build, describe, nearest, parse_seeds, plain
from headway.contracts import HeadwayError, require_value

NAN = float("nan")


@dataclass(frozen=True)
class Inner:
    share: float = 0.5
    """A share
    of the whole."""
    window: tuple[float, float] = (5.0, 24.0)

    def __post_init__(self) -> None:
        require_value(self, "share", 0 <= self.share <= 1, "must be between 0 and 1")
        if self.window[1] < self.window[0]:
            raise ValueError("the window ends before it begins")


@dataclass(frozen=True)
class Outer:
    lr: float = 3e-4
    """Learning rate."""
    epochs: int = 5
    verbose: bool = False
    activation: Literal["tanh", "relu"] = "tanh"
    hidden: tuple[int, ...] = (64, 64)
    limit: float | None = None
    extra: Mapping[str, float] = field(default_factory=dict)
    inner: Inner = field(default_factory=Inner)


@dataclass(frozen=True)
class Needy:
    folder: str


def test_nested_records_tuples_and_unions_are_built() -> None:
    built = build(
        Outer,
        {"lr": 1, "hidden": [32], "limit": 2, "extra": {"a": 1}, "inner": {"window": [6, 20]}, "epochs": 1e1},
    )
    assert built == Outer(
        lr=1.0, hidden=(32,), limit=2.0, extra={"a": 1.0}, inner=Inner(window=(6.0, 20.0)), epochs=10
    )
    assert isinstance(built.lr, float)
    assert isinstance(built.epochs, int)
    assert build(Outer, {"limit": None}).limit is None


def test_a_plain_record_builds_the_same_record_again() -> None:
    record = Outer(hidden=(8, 8), inner=Inner(share=0.25))
    assert build(Outer, plain(record)) == record


def test_null_for_a_group_of_keys_is_its_defaults() -> None:
    assert build(Outer, {"inner": None}) == build(Outer, {})


@pytest.mark.parametrize(
    ("mapping", "parts"),
    [
        ({"lrr": 1e-3}, ["algo.lrr is not a key of mappo", "did you mean algo.lr?"]),
        ({"inner": {"shar": 0.1}}, ["algo.inner.shar is not a key", "did you mean algo.inner.share?"]),
        ({"lr": "3e-4"}, ["algo.lr='3e-4' is text, where a number is expected", "without quotes"]),
        ({"lr": "abc"}, ["algo.lr='abc' is text, where a number is expected; give a number, such as 0.0003"]),
        ({"epochs": "abc"}, ["where a whole number is expected; give a whole number, such as 5"]),
        ({"limit": "abc"}, ["give a number, such as 3e-4"]),
        ({"epochs": True}, ["algo.epochs=true is true or false, where a whole number is expected"]),
        ({"epochs": 2.5}, ["algo.epochs=2.5 is a number, where a whole number is expected"]),
        ({"verbose": 1}, ["algo.verbose=1 is a whole number, where true or false is expected"]),
        ({"lr": None}, ["algo.lr=null is null, where a number is expected"]),
        ({"limit": "none"}, ["algo.limit='none' is text"]),
        ({"activation": "tan"}, ["algo.activation='tan' is not possible", "did you mean tanh?", "relu"]),
        ({"hidden": 64}, ["algo.hidden=64 is a whole number, where a list of whole numbers is expected"]),
        ({"hidden": [64, "64"]}, ["algo.hidden[1]='64' is text"]),
        ({"inner": {"window": [1]}}, ["algo.inner.window=[1] is a list, where a list of 2"]),
        ({"inner": 3}, ["algo.inner=3 is a whole number, where a mapping of keys is expected"]),
        ({"inner": {"share": 2}}, ["algo.inner.share must be between 0 and 1, not 2.0"]),
        ({"inner": {"window": [2, 1]}}, ["algo.inner: the window ends before it begins"]),
        ({"epochs": 10**400}, ["algo.epochs is a whole number beyond 2^63"]),
        ({"epochs": 1e300}, ["algo.epochs=1e+300 is a number, where a whole number is expected"]),
        ({"lr": 10**400}, ["algo.lr is a whole number beyond 2^63"]),
        ({"lr": NAN}, ["algo.lr must be a number, not nan"]),
        ({"limit": NAN}, ["algo.limit must be a number, not nan"]),
        ({"extra": {"a": NAN}}, ["algo.extra.a must be a number, not nan"]),
        ({"inner": {"window": [1.0, NAN]}}, ["must be a number, not nan"]),
        ({"extra": {"_target_": "os.system"}}, ["algo.extra._target_ is not allowed"]),
    ],
)
def test_bad_input_gives_one_line_that_names_the_key(mapping: dict[str, Any], parts: list[str]) -> None:
    with pytest.raises(HeadwayError) as caught:
        build(Outer, mapping, "algo", "mappo")
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


@dataclass(frozen=True)
class Fixed:
    shape: Literal["round"] = "round"
    """A circle. For corners take the square."""


def test_another_value_of_a_fixed_key_names_the_alternative() -> None:
    assert build(Fixed, {"shape": "round"}).shape == "round"
    line = r"^algo.shape='edged' is not possible: circle has shape=round\. A circle\. For corners take"
    with pytest.raises(HeadwayError, match=line):
        build(Fixed, {"shape": "edged"}, "algo", "circle")


def test_a_missing_key_without_default_is_named() -> None:
    with pytest.raises(HeadwayError, match=r"env\.args\.folder is missing"):
        build(Needy, {}, "env.args")


def test_impossible_values_of_platform_keys_are_one_line_errors() -> None:
    with pytest.raises(HeadwayError, match=r"^rollout\.block must divide copies \(8\), not 3$"):
        build(ExperimentConfig, {"rollout": {"block": 3}})
    with pytest.raises(HeadwayError, match=r"^env_steps must be at least 1, not 0$"):
        build(ExperimentConfig, {"env_steps": 0})
    with pytest.raises(HeadwayError, match=r"backend\.name='slurm' is not possible"):
        build(BackendConfig, {"name": "slurm"}, "backend")


@pytest.mark.parametrize(
    ("value", "seeds"),
    [
        (7, (7,)),
        ("7", (7,)),
        ("0,1,2", (0, 1, 2)),
        ([0, 1], (0, 1)),
        ("[0, 1]", (0, 1)),
        ("0..4", (0, 1, 2, 3, 4)),
        ("range(0,3)", (0, 1, 2)),
        ("range(0, 10, 4)", (0, 4, 8)),
        ("0..2,7", (0, 1, 2, 7)),
        (["0..1", 5], (0, 1, 5)),
    ],
)
def test_seed_forms(value: object, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(value) == seeds


@pytest.mark.parametrize(
    ("value", "message"),
    [
        *((value, r"0\.\.49") for value in ("a", "", "-1", -1, "1..", "range(3,3)", 1.5, True, None, "0;1")),
        ("0..300000", "seed=0..300000 is 300,001 seeds; give at most 10,000"),
        ("range(0,10001)", "is 10,001 seeds"),
        ("9" * 5000, "seed=9{24}... has more than 18 digits; give smaller seeds"),
        (10**19, "has more than 18 digits"),
        ("9..2", r"did you mean 2\.\.9"),
    ],
)
def test_other_seeds_are_refused(value: object, message: str) -> None:
    """Seeds of unknown form with a list of the forms, too many and too large ones, and reversed ranges."""
    with pytest.raises(HeadwayError, match=message):
        parse_seeds(value)


def test_describe_reads_types_defaults_and_the_docstrings_under_fields() -> None:
    described = {row.key: row for row in describe(Outer)}
    assert described["lr"].type == "number"
    assert described["lr"].default == "0.0003"
    assert described["lr"].doc == "Learning rate."
    assert described["activation"].type == "one of tanh, relu"
    assert described["limit"].type == "number or null"
    assert described["inner.share"].doc == "A share of the whole."
    assert [row.default for row in describe(Needy)] == ["required"]


def test_an_abbreviation_matches_a_name() -> None:
    assert nearest("idm", ["idle", "idm_mobil"]) == "idm_mobil"
    assert nearest("Merge", ["merge_two_lane", "merge"]) == "merge"
    assert nearest("id", ["idle"]) == "idle"  # two letters are compared as any others
    assert nearest("Mapo", ["mappo", "ippo"]) == "mappo"
    assert nearest("qqqq", ["mappo", "ippo"]) is None

"""Batched wrappers against SuperSuit's own on the same data."""

import pickle
from typing import Any

import numpy as np
import pytest
from covering import quick_or_slow
from same_game import assert_same_game, prepared, through_supersuit

from headway.adapters.conformance import CHECKS, play
from headway.contracts import HeadwayError
from headway.wrappers.listed import listed_wrappers
from headway.wrappers.parallel import bounds_of
from headway_envs.registry import ENTRIES

STACK = {"name": "frame_stack_v1", "stack_size": 3}
STACK_REPEATING = {"name": "frame_stack_v2", "stack_size": 3}
NORMALISE = {"name": "normalize_obs_v0", "env_min": -1.0, "env_max": 2.0}
CLIP = {"name": "clip_reward_v0", "lower_bound": -0.1, "upper_bound": 0.4}
SCALE = {"name": "scale_reward_v0", "scale": 0.3}
FLOAT32 = {"name": "dtype_v0", "dtype": "float32"}

CASES: dict[str, tuple[str, list[Any]]] = {
    "stack repeating visitors": ("visitors", [STACK_REPEATING]),
    **{
        f"chain {name}": (name, [STACK, "agent_indicator_v0", SCALE, CLIP])
        for name in ENTRIES
        if name != "bus"  # see "all bus"
    },
    "normalise trivial": ("trivial", [NORMALISE]),
    "types visitors": ("visitors", [{"name": "agent_indicator_v0", "type_only": True}]),
    "indicator between bounds": ("trivial", [NORMALISE, "agent_indicator_v0", STACK]),
    "all bus": ("bus", [NORMALISE, STACK, "agent_indicator_v0", "flatten_v0", FLOAT32, CLIP]),
    "all visitors": ("visitors", [STACK, STACK_REPEATING, "agent_indicator_v0", SCALE, CLIP]),
}

SHORT: dict[str, dict[str, Any]] = {
    "bus": {"end_hour": 8},
    "intersection": {"horizon": 110},
    "junctions": {"horizon": 60, "slots": 40},
    "bus_published": {"scenario": "line"},
}
"""Arguments of environments whose episodes are long."""


@pytest.mark.parametrize("case", quick_or_slow({case: (case,) for case in CASES}, "all visitors"))
def test_a_batched_form_equals_supersuit(case: str) -> None:
    name, wrappers = CASES[case]
    wrapped = prepared(name, ENTRIES[name], wrappers, **SHORT.get(name, {}))
    assert wrapped.parallel is None
    assert wrapped.notices == ()
    assert_same_game(wrapped.batch(1), through_supersuit(wrapped, ENTRIES[name], wrappers))


@pytest.mark.parametrize("case", ["all bus", "indicator between bounds", "normalise trivial"])
def test_a_batched_form_has_supersuit_s_bounds(case: str) -> None:
    name, wrappers = CASES[case]
    wrapped = prepared(name, ENTRIES[name], wrappers)
    make = ENTRIES[name].parallel_env
    assert make is not None
    env = make(wrapped.prepared)
    for wrapper in listed_wrappers(wrappers):
        env = wrapper.entry.wrap(env, wrapper.arguments)
    expected, bounds = bounds_of(env), wrapped.batched[-1].bounds
    assert expected is not None
    np.testing.assert_array_equal(bounds.low, expected.low)
    np.testing.assert_array_equal(bounds.high, expected.high)
    assert wrapped.batch(2).spec.observation_size == len(bounds.low)


@pytest.mark.slow
@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("case", ["all visitors", "all bus", "stack repeating visitors"])
def test_a_wrapped_batch_keeps_the_contract(case: str, check: str) -> None:
    """Snapshots too, which include the frames of a stack."""
    name, wrappers = CASES[case]
    wrapped = pickle.loads(pickle.dumps(prepared(name, ENTRIES[name], wrappers, **SHORT.get(name, {}))))
    assert wrapped.batch(1).spec.snapshots
    CHECKS[check](wrapped.batch, play(wrapped.batch))


def test_a_dtype_other_than_float32_has_no_batched_form() -> None:
    with_twin = prepared("trivial", ENTRIES["trivial"], [FLOAT32])
    assert with_twin.parallel is None
    without = prepared("trivial", ENTRIES["trivial"], [{"name": "dtype_v0", "dtype": "float64"}, STACK])
    assert without.parallel is not None
    assert [name for name, _ in without.parallel.wrappers] == ["dtype_v0", "frame_stack_v1"]


def test_bounds_that_are_not_finite_cannot_be_normalised() -> None:
    with pytest.raises(HeadwayError, match=r"env.wrappers\[0\]: normalize_obs_v0 needs finite bounds"):
        prepared("visitors", ENTRIES["visitors"], ["normalize_obs_v0"])


def test_types_must_be_in_the_names_of_agents() -> None:
    """An indicator of types alone needs names such as bus_0."""
    with pytest.raises(HeadwayError, match="called type_number"):
        prepared("matrix", ENTRIES["matrix"], [{"name": "agent_indicator_v0", "type_only": True}])

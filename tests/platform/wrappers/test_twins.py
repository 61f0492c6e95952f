"""Batched wrappers against SuperSuit's own on the same data."""

import pickle
from typing import Any

import numpy as np
import pytest
from same_game import assert_same_game, prepared, through_supersuit

from headway.adapters.conformance import CHECKS, play
from headway.contracts import BatchWrapper, EnvSpec, HeadwayError, ObservationBounds
from headway.wrappers.listed import listed_wrappers
from headway.wrappers.parallel import bounds_of
from headway_envs.registry import ENTRIES

STACK = {"name": "frame_stack_v1", "stack_size": 3}
STACK_REPEATING = {"name": "frame_stack_v2", "stack_size": 3}
NORMALISE = {"name": "normalize_obs_v0", "env_min": -1.0, "env_max": 2.0}
CLIP = {"name": "clip_reward_v0", "lower_bound": -0.1, "upper_bound": 0.4}
SCALE = {"name": "scale_reward_v0", "scale": 0.3}

CASES: dict[str, tuple[str, list[Any]]] = {
    # Each wrapper alone, then each on every environment, one behind the other.
    "stack": ("tracking", [STACK]),
    "stack repeating visitors": ("visitors", [STACK_REPEATING]),
    "indicator": ("trivial", ["agent_indicator_v0"]),
    "clip": ("visitors", [CLIP]),
    "scale": ("matrix", [SCALE]),
    **{f"chain {name}": (name, [STACK, "agent_indicator_v0", SCALE, CLIP]) for name in ENTRIES},
    "chain repeating bus": ("bus", ["agent_indicator_v0", STACK_REPEATING]),
    "normalise trivial": ("trivial", [NORMALISE]),
    "normalise bus": ("bus", [NORMALISE]),
    "types visitors": ("visitors", [{"name": "agent_indicator_v0", "type_only": True}]),
    "indicator between bounds": ("trivial", [NORMALISE, "agent_indicator_v0", STACK]),
    "all bus": (
        "bus",
        [
            NORMALISE,
            STACK,
            "agent_indicator_v0",
            "flatten_v0",
            {"name": "dtype_v0", "dtype": "float32"},
            CLIP,
        ],
    ),
    "stack of normalised bus": ("bus", [NORMALISE, STACK]),
    "all visitors": ("visitors", [STACK, STACK_REPEATING, "agent_indicator_v0", SCALE, CLIP]),
}

SHORT: dict[str, dict[str, Any]] = {"intersection": {"horizon": 150}, "bus_published": {"scenario": "line"}}
"""Arguments of environments whose episodes are long."""


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
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
    wrapped = pickle.loads(pickle.dumps(prepared(name, ENTRIES[name], wrappers)))
    assert wrapped.batch(1).spec.snapshots
    CHECKS[check](wrapped.batch, play(wrapped.batch))


def test_a_stack_is_cleared_for_ended_and_absent_agents() -> None:
    """Computed by hand, with NaN in every absent row of `visitors`."""
    wrapped = prepared("visitors", ENTRIES["visitors"], [STACK])
    plain = ENTRIES["visitors"].make(wrapped.prepared, 4)
    env, seeds = wrapped.batch(4), np.arange(4, dtype=np.uint64)
    faced, observed = plain.reset(seeds), env.reset(seeds)
    size = plain.spec.observation_size
    frames = [np.where(faced.alive[..., None], faced.observations, 0)]
    begun = np.zeros(faced.alive.shape, dtype=np.int64)
    seen_away = seen_over = 0
    for step in range(1, 130):
        actions = np.zeros(faced.alive.shape, dtype=np.int64)
        (outcome, faced), (_, observed) = plain.step(actions), env.step(actions)
        frames.append(np.where(faced.alive[..., None], faced.observations, 0).copy())
        over = outcome.terminated | outcome.truncated
        begun[over] = step
        seen_over += int((over & ~outcome.episode_ended[:, None]).sum())
        seen_away += int((~faced.alive).sum())
        for back in range(3):
            of_frame = observed.observations[..., (2 - back) * size : (3 - back) * size]
            known = step - back >= begun
            expected = np.where(known[..., None], frames[max(step - back, 0)], 0)
            np.testing.assert_array_equal(of_frame, expected if step >= back else 0 * expected)
    assert seen_away > 0
    assert seen_over > 0


def test_a_type_only_indicator_marks_types() -> None:
    bounds = ObservationBounds(
        ("bus_0", "bus_1", "tram_0"), np.zeros(2, dtype=np.float32), np.ones(2, dtype=np.float32)
    )
    listed = listed_wrappers([{"name": "agent_indicator_v0", "type_only": True}])[0]
    assert listed.entry.batched is not None
    twin = listed.entry.batched(listed.arguments, bounds)
    assert twin is not None
    assert len(twin.bounds.low) == 4
    place = np.zeros((1, 3, 4), dtype=np.float32)
    env: Any = twin.wrap(_Stub(3, 2))
    env._write(np.full((1, 3, 2), 7, dtype=np.float32), place)
    np.testing.assert_array_equal(place[0], [[7, 7, 1, 0], [7, 7, 1, 0], [7, 7, 0, 1]])
    unnamed = ObservationBounds(("Bus", "Tram"), bounds.low, bounds.high)
    with pytest.raises(HeadwayError, match="called type_number"):
        listed.entry.batched(listed.arguments, unnamed)


class _Stub(BatchWrapper):
    """The part of an environment that a wrapper uses at its creation."""

    def __init__(self, agents: int, size: int) -> None:
        from headway.contracts import Discrete

        names = tuple(f"agent_{index}" for index in range(agents))
        self._spec = EnvSpec("stub", names, observation_size=size, action_space=Discrete(2))

    @property
    def num_copies(self) -> int:
        return 1


def test_a_dtype_other_than_float32_has_no_batched_form() -> None:
    with_twin = prepared("trivial", ENTRIES["trivial"], [{"name": "dtype_v0", "dtype": "float32"}])
    assert with_twin.parallel is None
    without = prepared("trivial", ENTRIES["trivial"], [{"name": "dtype_v0", "dtype": "float64"}, STACK])
    assert without.parallel is not None
    assert [name for name, _ in without.parallel.wrappers] == ["dtype_v0", "frame_stack_v1"]


def test_bounds_that_are_not_finite_cannot_be_normalised() -> None:
    with pytest.raises(HeadwayError, match=r"env.wrappers\[0\]: normalize_obs_v0 needs finite bounds"):
        prepared("visitors", ENTRIES["visitors"], ["normalize_obs_v0"])

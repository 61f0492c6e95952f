"""The list of wrappers: names, arguments, one-line errors."""

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import supersuit
from same_game import prepared

from headway.config.schema import describe
from headway.config.signatures import argument_record
from headway.contracts import HeadwayError
from headway.registry import wrapper_entries
from headway.wrappers.listed import listed_wrappers
from headway.wrappers.supersuit import supersuit_entries, supersuit_names, why_not
from headway_envs.registry import ENTRIES


def test_names_and_mappings_can_be_mixed() -> None:
    listed = listed_wrappers([{"name": "frame_stack_v1", "stack_size": 2}, "clip_reward_v0"])
    assert [wrapper.mapping for wrapper in listed] == [
        {"name": "frame_stack_v1", "stack_size": 2, "stack_dim": -1},
        {"name": "clip_reward_v0", "lower_bound": -1.0, "upper_bound": 1.0},
    ]
    assert listed_wrappers([wrapper.mapping for wrapper in listed]) == listed


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("frame_stack_v9", r"env.wrappers\[0\]: unknown wrapper 'frame_stack_v9'; did you mean frame_st"),
        ("frame_stack_v0", r"unknown wrapper 'frame_stack_v0'; did you mean frame_stack_v"),  # deprecated
        ("observation_lambda_v0", "observation_lambda_v0 cannot be used: it takes Python functions"),
        ("concat_vec_envs_v1", "concat_vec_envs_v1 cannot be used: it makes a vector of environments"),
        ({"name": "frame_stack_v1", "stak_size": 4}, r"\[0\].stak_size is not a key of frame_stack_v1; did"),
        ({"name": "delay_observations_v0", "dely": 4}, "did you mean env.wrappers.0..delay"),
        ({"name": "sticky_actions_v0"}, r"wrappers\[0\].repeat_action_probability is missing and has no"),
        ({"name": "frame_stack_v1", "stack_size": "four"}, "stack_size='four' is text, where a whole number"),
        ({"name": "frame_stack_v1", "stack_size": 0}, r"env.wrappers\[0\].stack_size must be at least 1"),
        ({"name": "frame_stack_v1", "stack_dim": 1}, "stack_dim must be 0 or -1"),
        ({"name": "normalize_obs_v0", "env_min": 1}, "env_min must be below env_max"),
        ({"name": "clip_reward_v0", "lower_bound": 0.5}, "must have 0 between them"),
        ({"name": "scale_reward_v0", "scale": float("nan")}, "scale must be a number, not nan"),
        ({"name": "dtype_v0", "dtype": "flaot32"}, "must name a numpy type such as float32, not flaot32"),
        ({"stack_size": 4}, r"env.wrappers\[0\]=.* is not a wrapper; write a name"),
        (4, "is not a wrapper; write a name"),
        ({"name": "_target_"}, "unknown wrapper '_target_'"),
        ({"name": "__builtins__"}, "unknown wrapper '__builtins__'"),
    ],
)
def test_unusable_items_are_one_line_errors(item: Any, message: str) -> None:  # noqa: ANN401 - whatever YAML holds
    with pytest.raises(HeadwayError, match=message):
        listed_wrappers([item])


def test_every_wrapper_of_supersuit_is_listed_or_refused_with_a_reason() -> None:
    exported = {name for name in dir(supersuit) if name.rpartition("_v")[2].isdigit()}
    assert set(supersuit_names()) == exported
    refused = {name for name in exported if why_not(name)}
    assert exported - refused == set(wrapper_entries()) - {"scale_reward_v0"}
    assert {"reward_lambda_v0", "gym_vec_env_v0", "pettingzoo_env_to_vec_env_v1"} <= refused


@pytest.mark.parametrize("name", sorted(set(supersuit_names()) & set(wrapper_entries())))
def test_arguments_and_defaults_are_supersuits(name: str) -> None:
    """The argument records of batched forms must match SuperSuit's signatures."""
    wrapper = vars(supersuit)[name]
    function = getattr(wrapper, "parallel_wrapper", None) or getattr(wrapper, "aec_wrapper", None) or wrapper
    theirs = argument_record(function, first=1)
    assert _defaults(wrapper_entries()[name].config) == _defaults(theirs)


@pytest.fixture
def without_supersuit(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for cached in (wrapper_entries, supersuit_entries):
        cached.cache_clear()
    monkeypatch.setitem(sys.modules, "supersuit", None)
    yield
    for cached in (wrapper_entries, supersuit_entries):
        cached.cache_clear()


@pytest.mark.usefixtures("without_supersuit")
def test_without_supersuit_headways_own_wrappers_remain() -> None:
    """A Python for which its dependency tinyscaler has no wheel: 3.13."""
    assert set(wrapper_entries()) == {
        *("agent_indicator_v0", "black_death_v3", "clip_reward_v0", "dtype_v0", "flatten_v0"),
        *("frame_stack_v1", "frame_stack_v2", "normalize_obs_v0", "scale_reward_v0"),
    }
    stacked = prepared("matrix", ENTRIES["matrix"], [{"name": "frame_stack_v1", "stack_size": 3}])
    assert (
        stacked.batch(1).spec.observation_size
        == 3 * prepared("matrix", ENTRIES["matrix"], []).batch(1).spec.observation_size
    )
    with pytest.raises(
        HeadwayError, match=r"wrappers\[0\]: pad_observations_v0 cannot be used: SuperSuit is "
    ):
        listed_wrappers(["pad_observations_v0"])
    with pytest.raises(HeadwayError, match="pip install --no-deps supersuit"):
        prepared("matrix", ENTRIES["matrix"], ["clip_reward_v0", "black_death_v3"])


def _defaults(record: type) -> dict[str, object]:
    return {row.key: _number_or_text(row.default) for row in describe(record)}


def _number_or_text(default: str) -> object:
    try:
        return float(default)
    except ValueError:
        return default


def test_clip_bounds_without_zero_are_refused() -> None:
    """Shows SuperSuit's behaviour that requires the check; remove both once SuperSuit changes."""
    make = ENTRIES["matrix"].parallel_env
    assert make is not None
    env = supersuit.clip_reward_v0(make(ENTRIES["matrix"].config()), 0.5, 20)
    env.reset(seed=0)
    _, rewards, *_ = env.step({"row": 0, "column": 0})  # the payoff is 11
    assert rewards["row"] == 11.5


PACKAGE = """
from dataclasses import dataclass, replace

from headway.contracts import BatchedWrapper, WrapperEntry
from headway.wrappers.rewards import ScaleReward, batched_scale_reward, scale_reward


@dataclass(frozen=True)
class Nothing:
    pass


def halved(env, arguments):
    return scale_reward(env, ScaleReward(0.5))


def halved_batch(arguments, bounds):
    return batched_scale_reward(ScaleReward(0.5), bounds)


ENTRIES = {"NAME": WrapperEntry("half the pay", Nothing, halved, halved_batch)}
"""


@pytest.fixture
def package(install: Callable[[str, str, str], None], request: pytest.FixtureRequest) -> Iterator[str]:
    """A package with a wrapper of the requested name."""
    name = request.param
    install(f"package_of_{name}", PACKAGE.replace("NAME", name), "headway.wrappers")
    wrapper_entries.cache_clear()
    yield name
    wrapper_entries.cache_clear()


@pytest.mark.parametrize("package", ["half_reward_v0"], indirect=True)
def test_another_package_adds_a_wrapper_by_entry_point(package: str) -> None:
    assert package in wrapper_entries()
    wrapped = prepared("matrix", ENTRIES["matrix"], [package])
    assert wrapped.parallel is None
    env = wrapped.batch(1)
    env.reset(np.zeros(1, dtype=np.uint64))
    np.testing.assert_array_equal(env.step(np.zeros((1, 2), dtype=np.int64))[0].rewards, [[5.5, 5.5]])
    through = prepared("matrix", ENTRIES["matrix"], [package, {"name": "delay_observations_v0", "delay": 1}])
    assert through.parallel is not None
    env = through.batch(1)
    env.reset(np.zeros(1, dtype=np.uint64))
    np.testing.assert_array_equal(env.step(np.zeros((1, 2), dtype=np.int64))[0].rewards, [[5.5, 5.5]])


@pytest.mark.parametrize("package", ["frame_stack_v1"], indirect=True)
def test_a_registered_name_cannot_be_taken(package: str) -> None:
    with pytest.raises(HeadwayError, match=r"'frame_stack_v1' is registered twice in headway\.wrappers"):
        wrapper_entries()

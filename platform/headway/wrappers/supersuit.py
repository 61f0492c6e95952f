"""Every wrapper of SuperSuit that YAML can name, with its arguments.

Without SuperSuit, whose dependency tinyscaler has no wheels for Python 3.13 and newer, only the wrappers that
Headway implements itself remain. Only resize_v1 needs tinyscaler: SuperSuit can be installed without it.
"""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

from headway.config.signatures import argument_record, as_tuples
from headway.contracts import HeadwayError, WrapperEntry
from headway.wrappers.frame_stack import FrameStack, batched_frame_stack
from headway.wrappers.observations import (
    AgentIndicator,
    DType,
    NoArguments,
    NormalizeObs,
    batched_agent_indicator,
    batched_dtype,
    batched_normalize_obs,
    unchanged,
)
from headway.wrappers.rewards import (
    ClipReward,
    ScaleReward,
    batched_clip_reward,
    batched_scale_reward,
    scale_reward,
)
from headway.wrappers.supersuit_module import imported_supersuit

_SUMMARIES = {
    "agent_indicator_v0": "append the agent to its observation, one-hot",
    "black_death_v3": "agents that die stay, with observations and rewards of zero",
    "clip_actions_v0": "clip Box actions to their bounds",
    "clip_reward_v0": "clip each reward to two bounds, in training only",
    "color_reduction_v0": "images: one colour channel, or greyscale",
    "delay_observations_v0": "observations from some steps ago",
    "dtype_v0": "observations as another numpy type",
    "flatten_v0": "observations as vectors",
    "frame_skip_v0": "repeat each action for some steps",
    "frame_stack_v1": "the last observations side by side; zeros before the first",
    "frame_stack_v2": "the last observations side by side; the first repeated before it",
    "max_observation_v0": "the maximum of the last observations",
    "nan_noop_v0": "a given action in place of NaN",
    "nan_random_v0": "a random action in place of NaN",
    "nan_zeros_v0": "zeros in place of a NaN action",
    "normalize_obs_v0": "observations scaled by the bounds of their space",
    "pad_action_space_v0": "Discrete or Box actions padded to the largest action space",
    "pad_observations_v0": "observations padded with zeros to the longest",
    "reshape_v0": "observations in another shape",
    "resize_v1": "images in another size",
    "scale_actions_v0": "Box actions multiplied",
    "scale_reward_v0": "each reward multiplied by a factor, in training only (Headway's own)",
    "sticky_actions_v0": "the previous action is repeated with some probability",
}
_REMEMBER = ("frame_stack_v1", "frame_stack_v2", "delay_observations_v0", "max_observation_v0")
"""Wrappers that remember observations."""
_CHANGE_ACTIONS = ("scale_actions_v0", "pad_action_space_v0")
Batched = tuple[type, Callable[[Any, Any], Any]]
_BATCHED: Mapping[str, Batched] = {
    "agent_indicator_v0": (AgentIndicator, batched_agent_indicator),
    "clip_reward_v0": (ClipReward, batched_clip_reward),
    "dtype_v0": (DType, batched_dtype),
    "flatten_v0": (NoArguments, unchanged),
    "frame_stack_v1": (FrameStack, partial(batched_frame_stack, False)),
    "frame_stack_v2": (FrameStack, partial(batched_frame_stack, True)),
    "normalize_obs_v0": (NormalizeObs, batched_normalize_obs),
}
"""Argument record and batched form of the wrappers that have one."""
_OWN: Mapping[str, type] = {"black_death_v3": NoArguments}
"""Argument records of wrappers around a ParallelEnv that are Headway's own."""
_NOT_FROM_YAML = ("_lambda_v", "vec_env_v", "vec_envs_v", "vectorize_")


def supersuit_names() -> tuple[str, ...]:
    """Return every versioned name of SuperSuit, including those that YAML cannot use.

    Without SuperSuit, return those that YAML can use.
    """
    try:
        supersuit = imported_supersuit()
    except HeadwayError:
        return tuple(name for name in _SUMMARIES if name != "scale_reward_v0")
    # Not by `hasattr`: SuperSuit's `__getattr__` raises ImportError for unknown names.
    return tuple(sorted(name for name in vars(supersuit) if name.rpartition("_v")[2].isdigit()))


def why_not(name: str) -> str | None:
    """Return the reason why YAML cannot use this wrapper of SuperSuit; None if it can."""
    if "_lambda_v" in name:
        return (
            "it takes Python functions, which YAML cannot hold; register a wrapper of your own by entry "
            "point headway.wrappers"
        )
    if any(part in name for part in _NOT_FROM_YAML):
        return "it makes a vector of environments for other libraries; rollout.copies does that here"
    if name not in _BATCHED and name not in _OWN:
        try:
            imported_supersuit()
        except HeadwayError as error:
            return str(error)
    return None


@cache
def supersuit_entries() -> Mapping[str, WrapperEntry]:
    """Return SuperSuit's wrappers by name, and scale_reward_v0."""
    entries = {name: _entry(name) for name in supersuit_names() if why_not(name) is None}
    entries["scale_reward_v0"] = WrapperEntry(
        _SUMMARIES["scale_reward_v0"], ScaleReward, scale_reward, batched_scale_reward, only_rewards=True
    )
    return dict(sorted(entries.items()))


def _entry(name: str) -> WrapperEntry:
    record, batched = _BATCHED.get(name, (_OWN.get(name), None))
    if record is None:
        record = argument_record(_signature_source(name), first=1)
    return WrapperEntry(
        summary=_SUMMARIES.get(name, "a wrapper of SuperSuit"),
        config=record,
        wrap=partial(_wrap, name),
        batched=batched,
        only_rewards=name == "clip_reward_v0",
        skips_steps=name == "frame_skip_v0",
        changes_actions=name in _CHANGE_ACTIONS,
    )


def _signature_source(name: str) -> Callable[..., Any]:
    """Return the callable whose signature lists a wrapper's arguments.

    Some of SuperSuit's names choose between an AEC and a parallel class; they take any arguments themselves.
    """
    wrapper = vars(imported_supersuit())[name]
    found: Callable[..., Any] = (
        getattr(wrapper, "parallel_wrapper", None) or getattr(wrapper, "aec_wrapper", None) or wrapper
    )
    return found


def _wrap(name: str, env: Any, arguments: Any) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    if name == "black_death_v3":
        from headway.wrappers.black_death import BlackDeath

        return BlackDeath(env)
    if name == "delay_observations_v0":
        from headway.wrappers.copied_observations import CopiedObservations

        env = CopiedObservations(env)
    if name == "frame_skip_v0":
        from headway.wrappers.seeded_draws import SeededDraws

        env = SeededDraws(env)
    given = {key: as_tuples(value) for key, value in vars(arguments).items()}
    wrapped = vars(imported_supersuit())[name](env, **given)
    if name in _REMEMBER:
        from headway.wrappers.slot_streams import SlotStreams

        wrapped = SlotStreams(wrapped)
    return wrapped

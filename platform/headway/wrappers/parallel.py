"""Wrappers around a ParallelEnv, applied in order and tried out before training starts."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from headway.config.schema import build
from headway.contracts import HeadwayError, ObservationBounds
from headway.contracts.errors import one_line
from headway.registry import wrapper_entry
from headway.wrappers.listed import ListedWrapper

_INFO_KEYS = ("alive", "acting", "action_mask", "slot_ended")
"""Keys of infos that every wrapper must pass on at every step, since PettingZoo has no other place for
them."""
_TRIAL_STEPS = 5


@dataclass(frozen=True)
class WrappedParallelEnv:
    """A picklable factory of a ParallelEnv with wrappers around it."""

    make: Callable[[Any], Any]
    """An environment entry's `parallel_env`."""
    prepared: Any
    """Argument of `make`."""
    wrappers: tuple[tuple[str, Mapping[str, Any]], ...]
    """Names and arguments of the wrappers, the innermost first."""

    def __call__(self) -> Any:  # noqa: ANN401 - PettingZoo comes without types
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = self.make(self.prepared)
            for name, arguments in self.wrappers:
                entry = wrapper_entry(name)
                env = entry.wrap(env, build(entry.config, arguments))
        return env


def wrapped_parallel_env(
    name: str, make: Callable[[Any], Any], prepared: object, wrappers: Sequence[ListedWrapper]
) -> WrappedParallelEnv:
    """Return a wrapped ParallelEnv's factory, after playing a few steps with each added wrapper.

    Raises HeadwayError, naming the wrapper, if one rejects the environment, fails, or drops keys from infos.
    """
    made = WrappedParallelEnv(make, prepared, ())
    info_keys = _trial_info_keys(made, f"environment {name}", "cannot be played")
    for wrapper in wrappers:
        arguments = {key: value for key, value in wrapper.mapping.items() if key != "name"}
        made = WrappedParallelEnv(make, prepared, (*made.wrappers, (wrapper.name, arguments)))
        subject = f"{wrapper.path}: {wrapper.name}"
        remaining = _trial_info_keys(made, subject, f"cannot wrap {name}")
        if lost := info_keys - remaining:
            raise HeadwayError(
                f"{subject} drops {', '.join(sorted(lost))} from the infos of {name}, which report live "
                "agents and allowed actions there; leave it out"
            )
        if wrapper.entry.skips_steps and info_keys & {"alive", "acting"}:
            raise HeadwayError(
                f"{subject} keeps `acting` of the last inner step only, but agents of {name} do not act at "
                "every step; leave it out"
            )
    return made


def bounds_of(env: Any) -> ObservationBounds | None:  # noqa: ANN401 - PettingZoo comes without types
    """Return the bounds of a ParallelEnv's observations.

    None unless all agents observe one float32 vector within the same bounds.
    """
    from gymnasium.spaces import Box

    agents = tuple(env.possible_agents)
    spaces = [env.observation_space(agent) for agent in agents]
    first = spaces[0]
    if not isinstance(first, Box) or len(first.shape) != 1 or first.dtype != np.float32:
        return None
    if any(space != first for space in spaces[1:]):
        return None
    return ObservationBounds(agents, first.low, first.high)


def _trial_info_keys(made: WrappedParallelEnv, subject: str, problem: str) -> set[str]:
    """Return which of `_INFO_KEYS` occur in the infos of a few steps of random play.

    Raises HeadwayError, beginning with `subject` and `problem`, if the environment fails.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = replace(made, make=_with_ending_slots(made.make))()
            try:
                return _info_keys(env)
            finally:
                env.close()
    except HeadwayError:
        raise
    except Exception as error:  # third parties' code may raise anything
        raise HeadwayError(f"{subject} {problem}: {one_line(error)}") from error


def _with_ending_slots(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a ParallelEnv factory in which every slot's stream ends at every step, if agents come and go.

    In the few steps of a trial, `slot_ended` would hardly ever occur otherwise.
    """
    from pettingzoo.utils import BaseParallelWrapper

    class Ending(BaseParallelWrapper):  # type: ignore[misc]  # PettingZoo comes without types
        def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
            *rest, infos = self.env.step(actions)
            marked = {
                agent: {**info, "slot_ended": "truncated"} if "alive" in info else info
                for agent, info in infos.items()
            }
            return (*rest, marked)

    return lambda prepared: Ending(make(prepared))


def _info_keys(env: Any) -> set[str]:  # noqa: ANN401 - PettingZoo comes without types
    _, infos = env.reset(seed=0)
    found: set[str] = set()
    for agent in env.possible_agents:
        env.action_space(agent).seed(0)
    for _ in range(_TRIAL_STEPS):
        found |= {key for info in infos.values() for key in info if key in _INFO_KEYS}
        if not env.agents:
            break
        *_, infos = env.step(
            {agent: _random_action(env, agent, infos.get(agent, {})) for agent in env.agents}
        )
    return found


def _random_action(env: Any, agent: str, info: Mapping[str, Any]) -> Any:  # noqa: ANN401 - an action of any space
    """Return a random action, allowed by the info's action mask if the space is Discrete."""
    from gymnasium.spaces import Discrete

    space, mask = env.action_space(agent), info.get("action_mask")
    if mask is None or not isinstance(space, Discrete):
        return space.sample()
    return space.sample(mask=np.asarray(mask, dtype=np.int8))

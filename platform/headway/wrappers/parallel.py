"""Wrappers around a ParallelEnv: applied in order, and tried before anything starts."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from headway.config.schema import build
from headway.contracts import HeadwayError, ObservationBounds
from headway.registry import wrapper_entry
from headway.wrappers.listed import ListedWrapper

CARRIED = ("alive", "acting", "action_mask", "slot_ended")
"""What infos hold that PettingZoo has no place for, at any step."""
_TRIED_STEPS = 5


@dataclass(frozen=True)
class WrappedParallelEnv:
    """How to make a ParallelEnv with wrappers around it. Picklable."""

    make: Callable[[Any], Any]
    """An environment entry's `parallel_env`."""
    prepared: Any
    wrappers: tuple[tuple[str, Mapping[str, Any]], ...]
    """Names and arguments, the innermost first."""

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
    """Wrap a ParallelEnv, one wrapper after another, and play a few steps after each.

    Raises HeadwayError, naming the wrapper, where one refuses what it is to wrap, fails, or loses what
    infos carry.
    """
    made = WrappedParallelEnv(make, prepared, ())
    carried = _tried(made, f"environment {name}", "cannot be played")
    for wrapper in wrappers:
        arguments = {key: value for key, value in wrapper.mapping.items() if key != "name"}
        made = WrappedParallelEnv(make, prepared, (*made.wrappers, (wrapper.name, arguments)))
        who = f"{wrapper.path}: {wrapper.name}"
        left = _tried(made, who, f"cannot wrap {name}")
        if lost := carried - left:
            raise HeadwayError(
                f"{who} loses {', '.join(sorted(lost))} from the infos of {name}, which says so who is there "
                "and what is allowed; leave it out"
            )
        if wrapper.entry.skips_steps and carried & {"alive", "acting"}:
            raise HeadwayError(
                f"{who} keeps `acting` of the last of its steps only, and the agents of {name} do not act at "
                "every step; leave it out"
            )
    return made


def bounds_of(env: Any) -> ObservationBounds | None:  # noqa: ANN401 - PettingZoo comes without types
    """Of a ParallelEnv; None where its agents do not all observe one vector of float32 within the same
    bounds."""
    from gymnasium.spaces import Box

    agents = tuple(env.possible_agents)
    spaces = [env.observation_space(agent) for agent in agents]
    first = spaces[0]
    if not isinstance(first, Box) or len(first.shape) != 1 or first.dtype != np.float32:
        return None
    if any(space != first for space in spaces[1:]):
        return None
    return ObservationBounds(agents, first.low, first.high)


def _tried(made: WrappedParallelEnv, who: str, what: str) -> set[str]:
    """Which of `CARRIED` infos held in the first few steps of random play."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = replace(made, make=_EndingSlots(made.make))()
            try:
                return _carried(env)
            finally:
                env.close()
    except HeadwayError:
        raise
    except Exception as error:  # anything may go wrong in the code of others
        reason = str(error).splitlines()[0] if str(error) else "no reason given"
        raise HeadwayError(f"{who} {what}: {type(error).__name__}: {reason}") from error


@dataclass(frozen=True)
class _EndingSlots:
    """A ParallelEnv in which a slot's stream ends at every step wherever agents come and go: in a few steps
    of play that would hardly happen by itself."""

    make: Callable[[Any], Any]

    def __call__(self, prepared: object) -> Any:  # noqa: ANN401 - PettingZoo comes without types
        from pettingzoo.utils import BaseParallelWrapper

        class Ending(BaseParallelWrapper):  # type: ignore[misc]  # PettingZoo comes without types
            def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
                *rest, infos = self.env.step(actions)
                marked = {
                    agent: {**info, "slot_ended": "truncated"} if "alive" in info else info
                    for agent, info in infos.items()
                }
                return (*rest, marked)

        return Ending(self.make(prepared))


def _carried(env: Any) -> set[str]:  # noqa: ANN401 - PettingZoo comes without types
    _, infos = env.reset(seed=0)
    found: set[str] = set()
    for agent in env.possible_agents:
        env.action_space(agent).seed(0)
    for _ in range(_TRIED_STEPS):
        found |= {key for info in infos.values() for key in info if key in CARRIED}
        if not env.agents:
            break
        *_, infos = env.step({agent: _drawn(env, agent, infos.get(agent, {})) for agent in env.agents})
    return found


def _drawn(env: Any, agent: str, info: Mapping[str, Any]) -> Any:  # noqa: ANN401 - an action of any space
    from gymnasium.spaces import Discrete

    space, mask = env.action_space(agent), info.get("action_mask")
    if mask is None or not isinstance(space, Discrete):
        return space.sample()
    return space.sample(mask=np.asarray(mask, dtype=np.int8))

"""Conversion of Gymnasium's spaces to those of the contracts."""

from collections.abc import Callable, Mapping
from math import prod
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, HeadwayError, MultiDiscrete

Space = spaces.Space[Any]
Decode = Callable[[NDArray[Any]], list[Any]]
"""Converts one copy's actions, (N,) or (N, size), to a list of N actions for the environment."""


def observation_size(name: str, observation_spaces: Mapping[str, Space]) -> int:
    """Return the length of the flattened observation, the same for every agent; `name` is the environment's.

    Raises HeadwayError if a space is not a Box or shapes differ between agents.
    """
    for agent, space in observation_spaces.items():
        if not isinstance(space, spaces.Box):
            hint = (
                "put an action mask in info['action_mask'] and give the rest as a Box"
                if isinstance(space, spaces.Dict)
                else "flatten it to a Box (Gymnasium's FlattenObservation)"
            )
            raise HeadwayError(f"environment '{name}': agent '{agent}' observes a {space}; {hint}")
    _require_equal(
        name,
        "observation spaces",
        observation_spaces,
        lambda one, other: one.shape == other.shape,
        "pad_observations_v0",
    )
    return prod(next(iter(observation_spaces.values())).shape or ())


def action_space(name: str, action_spaces: Mapping[str, Space]) -> ActionSpace:
    """Return the action space, the same for every agent; `name` is the environment's.

    Raises HeadwayError if a space is not Discrete, MultiDiscrete or Box, or spaces differ between agents.
    """
    kinds = [_action_space(name, agent, space) for agent, space in action_spaces.items()]
    _require_equal(
        name, "action spaces", action_spaces, lambda one, other: one == other, "pad_action_space_v0"
    )
    return kinds[0]


def action_decoder(space: Space) -> Decode:
    """Return the function that converts one copy's actions to those of `space`.

    Box actions are clipped to the bounds. The results share no memory with the argument.
    """
    match space:
        case spaces.Discrete(start=start):
            first = int(start)
            if first == 0:
                return lambda actions: actions.tolist()
            return lambda actions: (actions + first).tolist()
        case spaces.MultiDiscrete(nvec=nvec, start=start):
            shape, dtype, offset = nvec.shape, space.dtype, start.ravel()
            return lambda actions: list((actions + offset).astype(dtype).reshape(-1, *shape))
        case spaces.Box(low=low, high=high):
            floor, ceiling, box_shape, box_dtype = low.ravel(), high.ravel(), space.shape, space.dtype
            return lambda actions: list(
                np.clip(actions, floor, ceiling).astype(box_dtype).reshape(-1, *box_shape)
            )
    raise TypeError(f"no decoder for {space}")


def _action_space(name: str, agent: str, space: Space) -> ActionSpace:
    match space:
        case spaces.Discrete(n=n):
            return Discrete(int(n))
        case spaces.MultiDiscrete(nvec=nvec):
            return MultiDiscrete(tuple(int(n) for n in nvec.ravel()))
        case spaces.Box(low=low, high=high):
            return Box(tuple(map(float, low.ravel())), tuple(map(float, high.ravel())))
    raise HeadwayError(
        f"environment '{name}': agent '{agent}' acts in a {space}; "
        "give it a Discrete, MultiDiscrete or Box action space"
    )


def _require_equal(
    name: str,
    what: str,
    by_agent: Mapping[str, Space],
    equal: Callable[[Space, Space], bool],
    wrapper: str,
) -> None:
    """Raise HeadwayError, naming agents and a wrapper as remedy, if spaces differ between agents."""
    groups: list[tuple[Space, list[str]]] = []
    for agent, space in by_agent.items():
        agents = next((agents for known, agents in groups if equal(known, space)), None)
        if agents is None:
            groups.append((space, [agent]))
        else:
            agents.append(agent)
    if len(groups) > 1:
        listed = "; ".join(f"{', '.join(agents)}: {space}" for space, agents in groups)
        raise HeadwayError(
            f"environment '{name}': agents have different {what} ({listed}); set env.wrappers=[{wrapper}]"
        )

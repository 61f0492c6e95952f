"""Arrays of a batch of copies, in the shapes of `headway.contracts`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, StepResult


def step_arrays(spec: EnvSpec, copies: int) -> dict[str, NDArray[Any]]:
    """Return the arrays that steps fill, by name: all zero, except that `masks` allow every action."""
    agents, space = (copies, spec.num_agents), spec.action_space
    observations, states = (*agents, spec.observation_size), (copies, spec.state_size)
    options = space.n if isinstance(space, Discrete) else 0
    return {
        "observations": np.zeros(observations, np.float32),
        "states": np.zeros(states, np.float32),
        "alive": np.zeros(agents, np.bool_),
        "masks": np.ones((*agents, options), np.bool_),
        "rewards": np.zeros(agents, np.float32),
        "acting": np.zeros(agents, np.bool_),
        "terminated": np.zeros(agents, np.bool_),
        "truncated": np.zeros(agents, np.bool_),
        "ended": np.zeros(copies, np.bool_),
        "final_observations": np.zeros(observations, np.float32),
        "final_states": np.zeros(states, np.float32),
        "metrics": np.zeros((copies, len(spec.metrics))),
    }


def step_result(arrays: Mapping[str, NDArray[Any]]) -> StepResult:
    """Return the result of a step whose arrays have the names of `step_arrays`."""
    return StepResult(
        rewards=arrays["rewards"],
        terminated=arrays["terminated"],
        truncated=arrays["truncated"],
        acting=arrays["acting"],
        episode_ended=arrays["ended"],
        final_observations=arrays["final_observations"],
        final_states=arrays["final_states"],
        metrics=arrays["metrics"],
    )

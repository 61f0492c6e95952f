"""Check of environment outputs for NaN and infinity, with an error that names copy, agent and step."""

from collections.abc import Callable, Iterator
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, HeadwayError, Observations, StepResult

NameCopy = Callable[[int], str]
"""Function from a row of a batch to the name of its copy, for instance "copy 3 of seed 7"."""


@np.errstate(over="ignore")
def check_finite(
    spec: EnvSpec,
    outcome: StepResult | None,
    observed: Observations,
    step: int,
    name_copy: NameCopy = "copy {}".format,
) -> None:
    """Raise HeadwayError for NaN or infinity in any value that a learner reads.

    These are observations of live agents, final observations of streams that end, states and all rewards.
    `outcome` is None after a reset.
    """
    for quantity, values, valid, hint in _checked_arrays(outcome, observed):
        # One test of the whole array first: a step without fault costs a few microseconds.
        if _surely_finite(values):
            continue
        bad = ~np.isfinite(values).all(axis=-1) & valid()
        if bad.any():
            raise HeadwayError(_error_line(spec, quantity, values, bad, step, name_copy) + hint)


def _checked_arrays(
    outcome: StepResult | None, observed: Observations
) -> Iterator[tuple[str, NDArray[np.float32], Callable[[], NDArray[np.bool_]], str]]:
    """Yield (name, values, mask of valid rows, hint) of each quantity to check.

    Values are (C, N or 1, size); the mask is a function that returns (C, N or 1); the hint ends the error
    line.
    """
    absent = ", or mark the agent as not alive there"
    yield "observation", observed.observations, lambda: observed.alive, absent
    yield "state", observed.states[:, None], lambda: np.ones((len(observed.states), 1), np.bool_), ""
    if outcome is None:
        return
    unpaid = "; an agent without a reward gets 0"
    yield "reward", outcome.rewards[..., None], lambda: np.ones_like(observed.alive), unpaid
    if not (np.count_nonzero(outcome.terminated) or np.count_nonzero(outcome.truncated)):
        return
    ends = outcome.terminated | outcome.truncated
    yield "final observation", outcome.final_observations, lambda: ends, ""
    yield "final state", outcome.final_states[:, None], lambda: outcome.episode_ended[:, None], ""


def _surely_finite(values: NDArray[np.float32]) -> bool:
    """Return whether the sum of squares is finite, which implies that all values are.

    Several times faster than testing each value; also False if the sum overflows.
    """
    flat = values.reshape(-1)
    return isfinite(flat.dot(flat))


def _error_line(
    spec: EnvSpec,
    quantity: str,
    values: NDArray[np.float32],
    bad: NDArray[np.bool_],
    step: int,
    name_copy: NameCopy,
) -> str:
    copy, agent = (int(i) for i in np.argwhere(bad)[0])
    of_agent = "" if quantity.endswith("state") else f" of agent {spec.agents[agent]}"
    value = values[copy, agent][~np.isfinite(values[copy, agent])][0]
    return (
        f"environment {spec.name} returned {value} as {quantity}{of_agent} in {name_copy(copy)} at step "
        f"{step}; fix the environment"
    )

"""NaN and infinity are caught where they come in, with the place named."""

from collections.abc import Callable, Iterator
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, HeadwayError, Observations, StepResult

NameCopy = Callable[[int], str]
"""What to call a copy of a batch, by its row: "copy 3 of seed 7", say."""


def _copy(row: int) -> str:
    return f"copy {row}"


@np.errstate(over="ignore")
def check_finite(
    spec: EnvSpec, outcome: StepResult | None, observed: Observations, step: int, name_copy: NameCopy = _copy
) -> None:
    """Raise HeadwayError for a NaN or infinity where a learner looks: observations of live agents, final
    observations of agents whose stream ends, states, and all rewards (who gets nothing gets 0).

    Whole arrays are tested first, so a step without fault costs a few microseconds. `outcome` is None
    where nothing was done yet.
    """
    for what, values, present, remedy in _looked_at(outcome, observed):
        if _surely_finite(values):
            continue
        bad = ~np.isfinite(values).all(axis=-1) & present()
        if bad.any():
            raise HeadwayError(_line(spec, what, values, bad, step, name_copy) + remedy)


def _looked_at(
    outcome: StepResult | None, observed: Observations
) -> Iterator[tuple[str, NDArray[np.float32], Callable[[], NDArray[np.bool_]], str]]:
    """What is looked at by name: (C, N or 1, size), where it counts (C, N or 1; asked for where a fault is
    suspected), and how to mend it."""
    alone = ", or mark the agent as not alive there"
    yield "observation", observed.observations, lambda: observed.alive, alone
    yield "state", observed.states[:, None], lambda: np.ones((len(observed.states), 1), np.bool_), ""
    if outcome is None:
        return
    idle = "; who gets nothing gets 0"
    yield "reward", outcome.rewards[..., None], lambda: np.ones_like(observed.alive), idle
    if not (np.count_nonzero(outcome.terminated) or np.count_nonzero(outcome.truncated)):
        return
    ends = outcome.terminated | outcome.truncated
    yield "final observation", outcome.final_observations, lambda: ends, ""
    yield "final state", outcome.final_states[:, None], lambda: outcome.episode_ended[:, None], ""


def _surely_finite(values: NDArray[np.float32]) -> bool:
    """One product, several times faster than looking at each number; false too where squares overflow."""
    flat = values.reshape(-1)
    return isfinite(flat.dot(flat))


def _line(
    spec: EnvSpec,
    what: str,
    values: NDArray[np.float32],
    bad: NDArray[np.bool_],
    step: int,
    name_copy: NameCopy,
) -> str:
    copy, agent = (int(i) for i in np.argwhere(bad)[0])
    who = "" if what.endswith("state") else f" of agent {spec.agents[agent]}"
    value = values[copy, agent][~np.isfinite(values[copy, agent])][0]
    return (
        f"environment {spec.name} gave {value} as {what}{who} in {name_copy(copy)} at step {step}; "
        "mend the environment"
    )

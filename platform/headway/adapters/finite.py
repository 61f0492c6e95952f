"""NaN and infinity are found where they arise, not in a loss many steps later."""

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, HeadwayError, Observed, Outcome


@np.errstate(over="ignore")
def check_finite(
    spec: EnvSpec, outcome: Outcome | None, observed: Observed, step: int, first_copy: int = 0
) -> None:
    """Check what one `step` returned (`outcome` None: what `reset` or `restore` did).

    Every reward, the observations of live agents, the final observations of agents whose stream has just
    ended, and states must be finite; other rows are not looked at. Whole arrays are tested first, so a
    step without fault costs a few microseconds.

    `step` and `first_copy` (the global index of copy 0) only make the message exact. Raises HeadwayError
    naming the environment, the copy, the agent and the step.
    """
    if not _surely_finite(observed.observations):
        _check_rows(spec, "an observation", observed.observations, observed.alive, step, first_copy)
    if not _surely_finite(observed.states):
        _check_states(spec, "the state", observed.states, None, step, first_copy)
    if outcome is None:
        return
    if not _surely_finite(outcome.rewards):
        everyone = np.ones_like(observed.alive)
        _check_rows(spec, "a reward", outcome.rewards[..., None], everyone, step, first_copy)
    if not (outcome.terminated.any() or outcome.truncated.any()):
        return
    ended = outcome.terminated | outcome.truncated
    if not _surely_finite(outcome.final_observations):
        _check_rows(spec, "a final observation", outcome.final_observations, ended, step, first_copy)
    if not _surely_finite(outcome.final_states):
        _check_states(spec, "the final state", outcome.final_states, outcome.episode_ended, step, first_copy)


def _surely_finite(values: NDArray[np.float32]) -> bool:
    """One product, several times faster than looking at each number; false too where squares overflow."""
    flat = values.reshape(-1)
    return isfinite(flat.dot(flat))


def _check_rows(
    spec: EnvSpec,
    what: str,
    values: NDArray[np.float32],
    rows: NDArray[np.bool_],
    step: int,
    first_copy: int,
) -> None:
    """Values (C, N, ...), rows (C, N): which to look at."""
    remedy = {
        "an observation": "mend the environment, or mark the agent as not alive",
        "a reward": "mend the environment; who gets nothing gets 0",
        "a final observation": "mend the environment; an agent that is away has its last observation there",
    }[what]
    faults = np.argwhere(rows & ~np.isfinite(values).all(axis=-1))
    if len(faults):
        copy, agent = faults[0]
        raise HeadwayError(
            f"environment '{spec.name}' gave {what} that is not finite: copy {first_copy + copy}, "
            f"agent '{spec.agents[agent]}', step {step}: {_first_bad(values[copy, agent])}; {remedy}"
        )


def _check_states(
    spec: EnvSpec,
    what: str,
    states: NDArray[np.float32],
    rows: NDArray[np.bool_] | None,
    step: int,
    first_copy: int,
) -> None:
    """States (C, S), rows (C,) or None for all."""
    bad = ~np.isfinite(states).all(axis=-1)
    faults = np.flatnonzero(bad if rows is None else bad & rows)
    if len(faults):
        copy = faults[0]
        raise HeadwayError(
            f"environment '{spec.name}' gave {what} that is not finite: copy {first_copy + copy}, "
            f"step {step}: {_first_bad(states[copy])}; mend the environment's state"
        )


def _first_bad(values: NDArray[np.float32]) -> str:
    index = int(np.flatnonzero(~np.isfinite(values))[0])
    return f"component {index} is {values[index]}"

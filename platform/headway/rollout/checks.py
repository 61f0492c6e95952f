"""NaN and infinity are caught where they come in, with the place named."""

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, HeadwayError, Observed, Outcome


def check_finite(
    spec: EnvSpec, outcome: Outcome | None, observed: Observed, step: int, first_copy: int
) -> None:
    """Raise HeadwayError for a NaN or infinity in what a live agent observes or is paid.

    One sum an array: a sum is finite unless an entry is not (or the sum overflows, which the precise
    look that follows tells apart).
    """
    if not np.isfinite(observed.observations.sum()):
        _locate(spec, observed.observations, observed.alive, "observation", step, first_copy)
    if observed.states.size and not np.isfinite(observed.states.sum()):
        everywhere = np.ones((len(observed.states), 1), np.bool_)
        _locate(spec, observed.states[:, None], everywhere, "state", step, first_copy)
    if outcome is not None and not np.isfinite(outcome.rewards.sum()):
        _locate(
            spec, outcome.rewards[..., None], np.isfinite(outcome.rewards) | True, "reward", step, first_copy
        )


def _locate(
    spec: EnvSpec,
    values: NDArray[np.float32],
    present: NDArray[np.bool_],
    what: str,
    step: int,
    first_copy: int,
) -> None:
    bad = ~np.isfinite(values).all(axis=-1) & present
    if not bad.any():
        return
    copy, agent = (int(i) for i in np.argwhere(bad)[0])
    who = "" if what == "state" else f" of agent {spec.agents[agent]}"
    value = values[copy, agent][~np.isfinite(values[copy, agent])][0]
    raise HeadwayError(
        f"environment {spec.name} gave {value} as {what}{who} in copy {first_copy + copy} at step {step}; "
        "mend the environment, or mark the agent as not alive there"
    )

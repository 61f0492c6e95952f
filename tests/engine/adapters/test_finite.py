"""The check for NaN looks at every number that means something, and at no other."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from headway.adapters.finite import check_finite
from headway.contracts import Discrete, EnvSpec, HeadwayError, Observed, Outcome

SPEC = EnvSpec("game", ("a", "b"), observation_size=2, action_space=Discrete(2), state_size=1)


def zeros() -> tuple[Outcome, Observed]:
    """C = 3, N = 2."""
    flags = np.zeros((3, 2), dtype=np.bool_)
    rows, states = np.zeros((3, 2, 2), dtype=np.float32), np.zeros((3, 1), dtype=np.float32)
    outcome = Outcome(
        rewards=np.zeros((3, 2), dtype=np.float32),
        terminated=flags.copy(),
        truncated=flags.copy(),
        acting=flags.copy(),
        episode_ended=np.zeros(3, dtype=np.bool_),
        final_observations=rows.copy(),
        final_states=states.copy(),
        metrics=np.zeros((3, 0)),
    )
    return outcome, Observed(rows.copy(), states.copy(), alive=~flags)


def test_rows_without_meaning_may_hold_anything() -> None:
    outcome, observed = zeros()
    observed.alive[1, 0] = False
    observed.observations[1, 0] = np.nan
    outcome.final_observations.fill(np.inf)
    outcome.final_states.fill(np.nan)
    outcome.truncated[2, 1] = True
    outcome.final_observations[2, 1] = 0
    check_finite(SPEC, outcome, observed, step=9)
    check_finite(SPEC, None, observed, step=0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("observations", "an observation that is not finite: copy 12, agent 'b', step 9: component 1 is nan"),
        ("states", "the state that is not finite: copy 12, step 9: component 0 is nan"),
        ("rewards", "a reward that is not finite: copy 12, agent 'b', step 9: component 0 is nan"),
        ("final_observations", "a final observation that is not finite: copy 12, agent 'b', step 9"),
        ("final_states", "the final state that is not finite: copy 12, step 9"),
    ],
)
def test_what_is_not_finite_is_named(name: str, message: str) -> None:
    outcome, observed = zeros()
    outcome.truncated[2] = True
    outcome.episode_ended[2] = True
    array: Any = getattr(observed if name in ("observations", "states") else outcome, name)
    array[(2, 1, 1)[: array.ndim] if "state" not in name else (2, 0)] = np.nan
    with pytest.raises(HeadwayError, match=message):
        check_finite(SPEC, outcome, observed, step=9, first_copy=10)


def test_large_numbers_are_finite() -> None:
    outcome, observed = zeros()
    huge = np.float32(np.finfo(np.float32).max)
    observed.observations.fill(huge)
    check_finite(SPEC, dataclasses.replace(outcome, rewards=np.full((3, 2), huge)), observed, step=1)

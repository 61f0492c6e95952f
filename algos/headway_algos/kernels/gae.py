"""Generalised advantage estimation."""

import numpy as np
from numpy.typing import NDArray

from headway.contracts.numba_setup import compiled_with
from headway_algos.kernels.compiled import Floats


def _write_advantages(
    rewards: Floats,
    values: Floats,
    final_values: Floats,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    present: NDArray[np.bool_],
    gamma: float,
    gae_lambda: float,
    advantages: Floats,
) -> None:
    """Write the results of `headway_algos.on_policy.gae.generalised_advantages`, for M streams, to
    `advantages` (T, M); `values` and `present` are (T + 1, M), the other arrays (T, M)."""
    steps, streams = rewards.shape
    for i in range(streams):
        next_value = values[steps, i] if present[steps, i] else 0.0
        next_advantage = 0.0
        for t in range(steps - 1, -1, -1):
            # Step t + 1 belongs to another stream; a truncated return continues with the value of its last
            # observation.
            if terminated[t, i] or truncated[t, i]:
                next_value = 0.0 if terminated[t, i] else final_values[t, i]
                next_advantage = 0.0
            target = rewards[t, i] + gamma * next_value
            if present[t, i]:
                advantages[t, i] = target - values[t, i] + gamma * gae_lambda * next_advantage
                next_value, next_advantage = values[t, i], advantages[t, i]
            else:
                # An absent agent has no action to credit: everything is passed on to its last action before,
                # discounted by gamma only, because lambda decays per action and not per step.
                advantages[t, i] = 0.0
                next_value, next_advantage = target, gamma * next_advantage


write_advantages = compiled_with(_write_advantages, _nrt=False)

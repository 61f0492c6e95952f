"""Comparison of a policy with what rollout workers compute."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, DescribedPolicy, HeadwayError, Observations, RecurrentPolicy
from headway.policies.description import Arrays
from headway.policies.policy import Policy

TOLERANCE = 1e-5
"""Largest difference of outputs and hidden states, relative where they exceed 1."""
Array = NDArray[Any]


def require_parity(
    policy: Policy, acting: DescribedPolicy, parameters: Arrays, observed: Observations, state: Array | None
) -> None:
    """Compare the policies on one block of observations (C, N, D), for live agents only.

    `acting` and `parameters` are those of the rollout workers; `state` (C, N, M) are the hidden states of the
    network, None without recurrent units.

    Raises HeadwayError if the distribution's parameters or the next hidden states differ by more than
    `TOLERANCE`, or if greedy actions differ that are not tied.
    """
    description, alive = policy.description, observed.alive
    rows = np.where(alive[..., None], observed.observations, np.float32(0))
    masks = None if observed.action_masks is None else observed.action_masks | ~alive[..., None]
    evaluation = policy.evaluate(rows, masks, state)
    outputs, after = acting.evaluate_network(parameters, observed, state)
    if description.network.output == "mean":
        spread = parameters["log_std"][list(description.network.policy_of_agent), :, 0]
        outputs = np.concatenate([outputs, np.broadcast_to(spread, outputs.shape)], -1)
    _require_close("network outputs", evaluation.outputs[alive], outputs[alive])
    if after is not None:
        assert evaluation.state is not None
        _require_close("hidden states", evaluation.state[alive], after[alive])
    if isinstance(acting, RecurrentPolicy):
        size, dtype = acting.hidden_size, acting.hidden_dtype
        hidden = np.zeros((*alive.shape, size), dtype) if state is None else state
        actions = acting.act_from(parameters, observed, hidden, None)[0]
    else:
        actions = acting.act(parameters, observed, None)[0]
    space = description.action_space
    if isinstance(space, Box):
        scale, offset = space.for_policies.scaling_to(space)
        expected = np.clip(scale * actions + offset, space.low, space.high)
        _require_close("actions", (evaluation.actions / scale)[alive], (expected / scale)[alive])
        return
    chosen = evaluation.actions.reshape(*alive.shape, -1)[alive]
    expected = actions.reshape(*alive.shape, -1)[alive]
    first = 0
    for choice, count in enumerate(description.action_space.options):
        values = outputs[alive][:, first : first + count]
        _require_close(
            "values of the greedy actions", *(_of(values, a[:, choice]) for a in (chosen, expected))
        )
        first += count


def _of(values: Array, options: Array) -> Array:
    return np.take_along_axis(values, options[:, None], axis=1)


def _require_close(what: str, found: Array, expected: Array) -> None:
    difference = np.abs(found - expected) / np.maximum(np.abs(expected), 1.0)
    if not (difference <= TOLERANCE).all():  # also false for NaN
        raise HeadwayError(
            f"the exported policy differs from the rollout workers': {what} by up to {difference.max():.2g}, "
            f"more than {TOLERANCE:g}; nothing was written, please report this"
        )

"""Inference restricted to live agents, for environments whose slots are mostly empty."""

from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Observations
from headway.contracts.acting_policy import Parameters

MIN_SLOTS = 32
"""Slots per copy from which empty ones are skipped; with fewer, call overhead exceeds the arithmetic."""
MIN_SLOTS_PER_AGENT = 2
"""Slots per live agent from which empty ones are skipped; with fewer, selecting rows costs what it saves."""

ActingResult = tuple[NDArray[Any], NDArray[np.float64], NDArray[Any] | None]
"""Actions (C, N, ...), log-probabilities (C, N), and hidden states (C, N, M) or None without recurrence."""


class MaskedActingPolicy(Protocol):
    """An acting policy that can compute all slots, or those of live agents only."""

    @property
    def single_agent(self) -> Self | None:
        """The same policy for copies of one agent that is always alive; results differ by rounding only.

        None if agents do not come and go, follow several policies, or have fewer than `MIN_SLOTS` slots.
        """
        ...

    def replicas(self, parameters: Parameters) -> int:
        """Return R, the number of replicas in `parameters`."""
        ...

    def act_on_all_slots(
        self,
        parameters: Parameters,
        observed: Observations,
        hidden_states: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> ActingResult:
        """Like `headway.contracts.RecurrentPolicy.act_from`; `hidden_states` is None without recurrence."""
        ...


def act_where_alive(
    policy: MaskedActingPolicy,
    parameters: Parameters,
    observed: Observations,
    hidden_states: NDArray[Any] | None,
    noise: NDArray[np.float64] | None,
) -> ActingResult:
    """Return the policy's result; if empty slots are skipped, their actions and log-probabilities are 0."""
    single = policy.single_agent
    if single is None:
        return policy.act_on_all_slots(parameters, observed, hidden_states, noise)
    replicas = policy.replicas(parameters)
    if replicas == 1:
        return _act_one_replica(policy, single, parameters, observed, hidden_states, noise)
    copies = len(observed.alive) // replicas
    blocks = [slice(r * copies, (r + 1) * copies) for r in range(replicas)]
    if not any(_mostly_empty(observed.alive[block]) for block in blocks):
        return policy.act_on_all_slots(parameters, observed, hidden_states, noise)
    # One replica at a time: live agents of other replicas must not change its last bits.
    results = [
        _act_one_replica(
            policy,
            single,
            {name: array[r : r + 1] for name, array in parameters.items()},
            Observations(
                observed.observations[block],
                observed.states[block],
                observed.alive[block],
                None if observed.action_masks is None else observed.action_masks[block],
            ),
            None if hidden_states is None else hidden_states[block],
            None if noise is None else noise[block],
        )
        for r, block in enumerate(blocks)
    ]
    return (
        np.concatenate([actions for actions, _, _ in results]),
        np.concatenate([log_probs for _, log_probs, _ in results]),
        None
        if hidden_states is None
        else np.concatenate([after for _, _, after in results if after is not None]),
    )


def _mostly_empty(alive: NDArray[np.bool_]) -> bool:
    return int(np.count_nonzero(alive)) * MIN_SLOTS_PER_AGENT <= alive.size


def _act_one_replica(
    policy: MaskedActingPolicy,
    single: MaskedActingPolicy,
    parameters: Parameters,
    observed: Observations,
    hidden_states: NDArray[Any] | None,
    noise: NDArray[np.float64] | None,
) -> ActingResult:
    """Act for R = 1; if most slots are empty, the B live agents are computed as B copies of one agent."""
    if not _mostly_empty(observed.alive):
        return policy.act_on_all_slots(parameters, observed, hidden_states, noise)
    live = observed.alive.ravel().nonzero()[0]
    masks, shape = observed.action_masks, observed.alive.shape
    selected = Observations(
        _select(observed.observations, live),
        np.zeros((len(live), 0), np.float32),
        np.ones((len(live), 1), np.bool_),
        None if masks is None else _select(masks, live),
    )
    actions, log_probs, after = single.act_on_all_slots(
        parameters,
        selected,
        None if hidden_states is None else _select(hidden_states, live),
        None if noise is None else _select(noise, live),
    )
    next_states = None
    if hidden_states is not None and after is not None:
        next_states = _insert(after, live, hidden_states.copy())
    return (
        _insert(actions, live, np.zeros((*shape, *actions.shape[2:]), actions.dtype)),
        _insert(log_probs, live, np.zeros(shape)),
        next_states,
    )


def _select(by_agent: NDArray[Any], live: NDArray[np.int64]) -> NDArray[Any]:
    """Return rows `live` (B,) of (C, N, ...) as (B, 1, ...)."""
    copies, agents, *rest = by_agent.shape
    return by_agent.reshape(copies * agents, 1, *rest).take(live, axis=0)


def _insert(selected: NDArray[Any], live: NDArray[np.int64], by_agent: NDArray[Any]) -> NDArray[Any]:
    """Write (B, 1, ...) to rows `live` (B,) of the contiguous (C, N, ...), and return that array."""
    copies, agents, *rest = by_agent.shape
    by_agent.reshape(copies * agents, 1, *rest)[live] = selected
    return by_agent


class FeedforwardActing:
    """Implements `act` for a `MaskedActingPolicy` without recurrence."""

    def act(
        self: MaskedActingPolicy,
        parameters: Parameters,
        observed: Observations,
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Implement `headway.contracts.ActingPolicy.act`. Agents not alive get any valid action, or 0."""
        actions, log_probs, _ = act_where_alive(self, parameters, observed, None, noise)
        return actions, log_probs


class RecurrentActing:
    """Implements `act_from` for a `MaskedActingPolicy` with recurrence."""

    def act_from(
        self: MaskedActingPolicy,
        parameters: Parameters,
        observed: Observations,
        hidden_states: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[Any]]:
        """Implement `headway.contracts.RecurrentPolicy.act_from`. Agents not alive get any valid action, or
        0."""
        actions, log_probs, next_states = act_where_alive(self, parameters, observed, hidden_states, noise)
        assert next_states is not None
        return actions, log_probs, next_states

"""Acting where most slots are empty: only what somebody is there for is computed."""

from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Observations
from headway.contracts.acting_policy import Parameters

FEWEST_SLOTS = 32
"""Slots in a copy from which on any are left out. With fewer, calls cost more than their arithmetic."""
SLOTS_EACH = 2
"""Slots for each agent that is there, from which on empty ones are left out. Where fewer are, to pick the
others costs about what it saves."""

Answer = tuple[NDArray[Any], NDArray[np.float64], NDArray[Any] | None]
"""Actions (C, N, ...), log-probabilities (C, N), and what is remembered (C, N, M), if anything is."""


class MaskedActingPolicy(Protocol):
    """An acting policy, of which `answer` computes every slot."""

    @property
    def alone(self) -> Self | None:
        """The same policy for one agent, who is always there: which rows stand in one product changes no
        more than last bits. None where agents do not come and go, follow several policies, or have few
        slots."""
        ...

    def replicas(self, parameters: Parameters) -> int:
        """R, of which parameters are."""
        ...

    def answer(
        self,
        parameters: Parameters,
        observed: Observations,
        memory: NDArray[Any] | None,
        noise: NDArray[np.float64] | None,
    ) -> Answer:
        """As `headway.contracts.RecurrentPolicy.act_from`; memory is None for a policy without."""
        ...


def answer_where_alive(
    policy: MaskedActingPolicy,
    parameters: Parameters,
    observed: Observations,
    memory: NDArray[Any] | None,
    noise: NDArray[np.float64] | None,
) -> Answer:
    """What a policy answers, zeros in empty slots where it leaves these out. Each of R replicas is computed
    as if it were the only one, so that the others who are there do not change its last bits."""
    alone = policy.alone
    if alone is None:
        return policy.answer(parameters, observed, memory, noise)
    replicas = policy.replicas(parameters)
    if replicas == 1:
        return _answer_of_one(policy, alone, parameters, observed, memory, noise)
    copies = len(observed.alive) // replicas
    blocks = [slice(r * copies, (r + 1) * copies) for r in range(replicas)]
    if not any(_mostly_empty(observed.alive[block]) for block in blocks):
        return policy.answer(parameters, observed, memory, noise)
    answers = [
        _answer_of_one(
            policy,
            alone,
            {name: array[r : r + 1] for name, array in parameters.items()},
            Observations(
                observed.observations[block],
                observed.states[block],
                observed.alive[block],
                None if observed.action_masks is None else observed.action_masks[block],
            ),
            None if memory is None else memory[block],
            None if noise is None else noise[block],
        )
        for r, block in enumerate(blocks)
    ]
    return (
        np.concatenate([actions for actions, _, _ in answers]),
        np.concatenate([log_probs for _, log_probs, _ in answers]),
        None if memory is None else np.concatenate([after for _, _, after in answers if after is not None]),
    )


def _mostly_empty(alive: NDArray[np.bool_]) -> bool:
    return int(np.count_nonzero(alive)) * SLOTS_EACH <= alive.size


def _answer_of_one(
    policy: MaskedActingPolicy,
    alone: MaskedActingPolicy,
    parameters: Parameters,
    observed: Observations,
    memory: NDArray[Any] | None,
    noise: NDArray[np.float64] | None,
) -> Answer:
    """Of a single replica, whose agents that are there become copies (B) of one agent."""
    if not _mostly_empty(observed.alive):
        return policy.answer(parameters, observed, memory, noise)
    there = observed.alive.ravel().nonzero()[0]
    masks, shape = observed.action_masks, observed.alive.shape
    picked = Observations(
        _pick(observed.observations, there),
        np.zeros((len(there), 0), np.float32),
        np.ones((len(there), 1), np.bool_),
        None if masks is None else _pick(masks, there),
    )
    actions, log_probs, after = alone.answer(
        parameters,
        picked,
        None if memory is None else _pick(memory, there),
        None if noise is None else _pick(noise, there),
    )
    remembered = None
    if memory is not None and after is not None:
        remembered = _place(after, there, memory.copy())
    return (
        _place(actions, there, np.zeros((*shape, *actions.shape[2:]), actions.dtype)),
        _place(log_probs, there, np.zeros(shape)),
        remembered,
    )


def _pick(by_agent: NDArray[Any], there: NDArray[np.int64]) -> NDArray[Any]:
    """(C, N, ...) -> (B, 1, ...)"""
    copies, agents, *rest = by_agent.shape
    return by_agent.reshape(copies * agents, 1, *rest).take(there, axis=0)


def _place(picked: NDArray[Any], there: NDArray[np.int64], by_agent: NDArray[Any]) -> NDArray[Any]:
    """(B, 1, ...) into (C, N, ...), which is contiguous and is returned."""
    copies, agents, *rest = by_agent.shape
    by_agent.reshape(copies * agents, 1, *rest)[there] = picked
    return by_agent


class FeedforwardActing:
    """Acts as it answers, for an `MaskedActingPolicy` without memory."""

    def act(
        self: MaskedActingPolicy,
        parameters: Parameters,
        observed: Observations,
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """See `headway.contracts.ActingPolicy`. Rows of agents not alive give any valid action, zeros where
        most are not."""
        actions, log_probs, _ = answer_where_alive(self, parameters, observed, None, noise)
        return actions, log_probs


class RecurrentActing:
    """The same for one with memory."""

    def act_from(
        self: MaskedActingPolicy,
        parameters: Parameters,
        observed: Observations,
        memory: NDArray[Any],
        noise: NDArray[np.float64] | None,
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[Any]]:
        """See `headway.contracts.RecurrentPolicy`. Rows of agents not alive as without memory; what they
        remember stays."""
        actions, log_probs, remembered = answer_where_alive(self, parameters, observed, memory, noise)
        assert remembered is not None
        return actions, log_probs, remembered

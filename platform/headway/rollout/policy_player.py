"""Acting policies during rollouts: evaluation in blocks of copies, with recurrent policies' hidden states."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Observations, RecurrentPolicy, StepResult
from headway.contracts.acting_policy import Parameters
from headway.rollout.plan import RolloutPlan

_BlockResult = tuple[NDArray[Any], NDArray[np.float64], NDArray[Any] | None]
"""Actions, log-probabilities and the next hidden states of a block; None without recurrence."""


class PolicyPlayer:
    """Computes actions for C = R x E copies (replica-major).

    Copies are split into blocks of a few per replica if the last bits of the policy's results depend on the
    block. Keeps the hidden states of a recurrent policy, so `reset_ended` must be called after every step.
    """

    def __init__(self, plan: RolloutPlan, copies: int, block: int) -> None:
        self.plan, self.copies = plan, copies
        if getattr(plan.policy, "any_block", False):
            block = copies
        self.blocks = [slice(start, min(start + block, copies)) for start in range(0, copies, block)]
        agents = (plan.replicas * copies, plan.spec.num_agents)
        self.recurrent_policy = plan.policy if isinstance(plan.policy, RecurrentPolicy) else None
        self.hidden_states: NDArray[Any] | None = None
        """(C, N, M); None for a policy without recurrence."""
        if self.recurrent_policy is not None:
            size, dtype = self.recurrent_policy.hidden_size, self.recurrent_policy.hidden_dtype
            self.hidden_states = np.zeros((*agents, size), dtype)
        self.begins = np.ones(agents, np.bool_)
        """(C, N): the agent's stream begins with the next observation."""

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Return actions (C, N, ...) and log-probabilities (C, N).

        `noise` (C, N, ...) is one step of the policy's noise; None: act greedily.
        """
        if len(self.blocks) == 1:
            actions, log_probs, self.hidden_states = self._act_block(
                parameters, observed, noise, self.hidden_states
            )
            return actions, log_probs
        parts = [
            self._act_block(
                parameters,
                Observations(
                    self._cut(observed.observations, block),
                    self._cut(observed.states, block),
                    self._cut(observed.alive, block),
                    None if observed.action_masks is None else self._cut(observed.action_masks, block),
                ),
                None if noise is None else self._cut(noise, block),
                None if self.hidden_states is None else self._cut(self.hidden_states, block),
            )
            for block in self.blocks
        ]
        if self.hidden_states is not None:
            self.hidden_states = self._join([part[2] for part in parts if part[2] is not None])
        return self._join([part[0] for part in parts]), self._join([part[1] for part in parts])

    def _act_block(
        self,
        parameters: Parameters,
        observed: Observations,
        noise: NDArray[np.float64] | None,
        hidden_states: NDArray[Any] | None,
    ) -> _BlockResult:
        if self.recurrent_policy is None or hidden_states is None:
            return *self.plan.policy.act(parameters, observed, noise), None
        return self.recurrent_policy.act_from(parameters, observed, hidden_states, noise)

    def reset_ended(self, outcome: StepResult) -> None:
        """Set the hidden states of agents whose stream ended to 0."""
        if self.hidden_states is not None:
            self.begins = outcome.terminated | outcome.truncated
            self.hidden_states[self.begins] = 0

    def reset(self) -> None:
        """Set all hidden states to 0 and mark every stream as beginning."""
        self.begins.fill(True)
        if self.hidden_states is not None:
            self.hidden_states.fill(0)

    def snapshot(self) -> dict[str, Any]:
        """Return the state that `restore` needs; empty for a policy without recurrence."""
        if self.hidden_states is None:
            return {}
        return {"memory": self.hidden_states.copy(), "begins": self.begins.copy()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot."""
        if self.hidden_states is not None:
            self.hidden_states, self.begins = snapshot["memory"].copy(), snapshot["begins"].copy()

    def _cut(self, array: NDArray[Any], block: slice) -> NDArray[Any]:
        """Return the rows of one block, (R x copies of the block, ...), of an array (C, ...)."""
        split = array.reshape(self.plan.replicas, self.copies, *array.shape[1:])[:, block]
        # The row count is explicit because -1 is ambiguous for an empty state.
        return split.reshape(split.shape[0] * split.shape[1], *array.shape[1:])

    def _join(self, parts: list[NDArray[Any]]) -> NDArray[Any]:
        """Return the array (C, ...) of the rows of all blocks."""
        replicas = self.plan.replicas
        split = [part.reshape(replicas, -1, *part.shape[1:]) for part in parts]
        return np.concatenate(split, axis=1).reshape(replicas * self.copies, *parts[0].shape[1:])

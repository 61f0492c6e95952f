"""Policies at play: their actions, computed block by block, and what their agents remember meanwhile."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Observations, RecurrentPolicy, StepResult
from headway.contracts.acting_policy import Parameters
from headway.rollout.plan import RolloutPlan

_Acted = tuple[NDArray[Any], NDArray[np.float64], NDArray[Any] | None]


class PolicyPlayer:
    """Actions of R x E copies (replica-major), computed in blocks of a few copies of each replica.

    Of a policy that remembers it keeps the memory: after each step it must be told the outcome (`heed`).
    """

    def __init__(self, plan: RolloutPlan, copies: int, block: int) -> None:
        self.plan, self.copies = plan, copies
        self.blocks = [slice(start, min(start + block, copies)) for start in range(0, copies, block)]
        agents = (plan.replicas * copies, plan.spec.num_agents)
        self.remembering = plan.policy if isinstance(plan.policy, RecurrentPolicy) else None
        self.memory: NDArray[Any] | None = None
        """(C, N, M); None for a policy without memory."""
        if self.remembering is not None:
            self.memory = np.zeros((*agents, self.remembering.hidden_size), self.remembering.hidden_dtype)
        self.begins = np.ones(agents, np.bool_)
        """(C, N): the agent's stream begins with what is observed next."""

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Actions and log-probabilities (C, N, ...); noise (C, N, ...) or None for greedy."""
        if len(self.blocks) == 1:
            actions, log_probs, self.memory = self._ask(parameters, observed, noise, self.memory)
            return actions, log_probs
        parts = [
            self._ask(
                parameters,
                Observations(
                    self._cut(observed.observations, block),
                    self._cut(observed.states, block),
                    self._cut(observed.alive, block),
                    None if observed.action_masks is None else self._cut(observed.action_masks, block),
                ),
                None if noise is None else self._cut(noise, block),
                None if self.memory is None else self._cut(self.memory, block),
            )
            for block in self.blocks
        ]
        if self.memory is not None:
            self.memory = self._join([part[2] for part in parts if part[2] is not None])
        return self._join([part[0] for part in parts]), self._join([part[1] for part in parts])

    def _ask(
        self,
        parameters: Parameters,
        observed: Observations,
        noise: NDArray[np.float64] | None,
        memory: NDArray[Any] | None,
    ) -> _Acted:
        if self.remembering is None or memory is None:
            return *self.plan.policy.act(parameters, observed, noise), None
        return self.remembering.act_from(parameters, observed, memory, noise)

    def heed(self, outcome: StepResult) -> None:
        """Agents whose stream ended forget."""
        if self.memory is not None:
            self.begins = outcome.terminated | outcome.truncated
            self.memory[self.begins] = 0

    def forget(self) -> None:
        """All begin anew."""
        self.begins.fill(True)
        if self.memory is not None:
            self.memory.fill(0)

    def snapshot(self) -> dict[str, Any]:
        """What `restore` needs; nothing for a policy without memory."""
        if self.memory is None:
            return {}
        return {"memory": self.memory.copy(), "begins": self.begins.copy()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a snapshot."""
        if self.memory is not None:
            self.memory, self.begins = snapshot["memory"].copy(), snapshot["begins"].copy()

    def _cut(self, array: NDArray[Any], block: slice) -> NDArray[Any]:
        split = array.reshape(self.plan.replicas, self.copies, *array.shape[1:])[:, block]
        # Not -1 for the rows: a state may have no component to count them by.
        return split.reshape(split.shape[0] * split.shape[1], *array.shape[1:])

    def _join(self, parts: list[NDArray[Any]]) -> NDArray[Any]:
        replicas = self.plan.replicas
        split = [part.reshape(replicas, -1, *part.shape[1:]) for part in parts]
        return np.concatenate(split, axis=1).reshape(replicas * self.copies, *parts[0].shape[1:])

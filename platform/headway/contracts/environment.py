"""The batched environment: C copies stepped at once with arrays."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts.spaces import ActionSpace


@dataclass(frozen=True)
class EnvSpec:
    """What an environment is: all that an algorithm may know before the first step."""

    name: str
    agents: tuple[str, ...]
    """Names of the N agents (slots, where vehicles come and go), in array order."""
    observation_size: int
    """D: every agent's observation is a float32 vector of this length."""
    action_space: ActionSpace
    state_size: int = 0
    """S: length of the global state for central critics; 0 if the environment gives none."""
    groups: tuple[str, ...] = ()
    """The group of each agent (a bus line, say) for `policies: groups`; empty: all in one group."""
    shared_reward: bool = False
    """The team's reward stands in every agent's slot, absent agents' too: a team's critic reads one."""
    shared_in_groups: bool = False
    """A group's reward stands in the slot of each of its agents, absent agents' too."""
    has_action_mask: bool = False
    agents_come_and_go: bool = False
    """`alive` can be false before the episode ends."""
    metrics: tuple[str, ...] = ()
    """Names of the M episode metrics."""
    max_copies_per_process: int | None = None
    """Copies that a process can hold, over all batches in it; None: any number."""
    snapshots: bool = False
    """`snapshot` and `restore` work, so that resuming and re-collection are exact."""

    @property
    def num_agents(self) -> int:
        """N."""
        return len(self.agents)


@dataclass(frozen=True, slots=True)
class Observations:
    """What the agents of C copies face now. The arrays belong to the environment, which overwrites them
    at its next step: whoever keeps them copies them. Rows of agents not alive may hold anything."""

    observations: NDArray[np.float32]
    """(C, N, D)"""
    states: NDArray[np.float32]
    """(C, S), finite; S is 0 where the environment gives no state."""
    alive: NDArray[np.bool_]
    """(C, N): the agent exists now."""
    action_masks: NDArray[np.bool_] | None = None
    """(C, N, A): which actions are allowed; every row of a live agent allows at least one. None: all are."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """What the step just taken led to. Arrays are overwritten at the next step.

    `terminated` and `truncated` are per agent: an agent's stream of experience ends where either is set.
    After a terminated step the return is over; after a truncated one it goes on from
    `final_observations`, which hold the last observation before any reset and are valid exactly where
    `truncated` or `terminated` is set. An agent that is merely not alive for a while (a bus at the
    depot) sets neither: its stream goes on when it returns. The two are never both set; where an
    environment says both, the agent is terminated. A slot whose agent was terminated or truncated may hold
    a new agent, with a new stream, later in the episode.

    A copy whose episode ended has every agent marked, those that are away too, and what `step` returns as
    `observed` is already the next episode's start. Where `truncated` is set, `final_observations` are finite:
    for an agent that is away, the last it observed.
    """

    rewards: NDArray[np.float32]
    """(C, N): finite for every slot; where no agent is, the team's if the reward is shared, else 0. What an
    agent is paid while away belongs to its stream."""
    terminated: NDArray[np.bool_]
    """(C, N)"""
    truncated: NDArray[np.bool_]
    """(C, N)"""
    acting: NDArray[np.bool_]
    """(C, N): the action just given was used; implies that the agent was alive before the step."""
    episode_ended: NDArray[np.bool_]
    """(C,)"""
    final_observations: NDArray[np.float32]
    """(C, N, D)"""
    final_states: NDArray[np.float32]
    """(C, S): valid where episode_ended."""
    metrics: NDArray[np.float64]
    """(C, M): valid where episode_ended."""


class BatchedEnv(Protocol):
    """C independent copies of an environment, stepped together; copies reset themselves (autoreset)."""

    @property
    def spec(self) -> EnvSpec: ...

    @property
    def num_copies(self) -> int:
        """C."""
        ...

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        """Begin episode 0 of every copy; seeds (C,). All randomness of copy c's episode i follows from
        (seeds[c], i) alone, whatever the other copies are."""
        ...

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Apply actions, (C, N) int64 or (C, N, size) float32. Actions of agents not alive are ignored."""
        ...

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque to the engine
        """A value from which `restore` continues bit for bit (only if spec.snapshots), such as a checkpoint
        holds: numpy arrays and scalars, numbers, strings, bytes, None, and lists, tuples and dicts of these,
        with strings or numbers as keys; no other object, not even one that can be pickled."""
        ...

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401
        """Continue from a snapshot; returns what was observed when it was taken. Works on a new environment
        with as many copies, without a reset before."""
        ...

    def close(self) -> None: ...

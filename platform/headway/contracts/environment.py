"""The batched environment: C copies, stepped at once with arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts.spaces import ActionSpace, Box


@dataclass(frozen=True)
class ObservationFeature:
    """One number of an observation: a quantity divided by `scale`."""

    name: str
    """Name, different from those of the observation's other numbers."""
    meaning: str
    """One line: the quantity, then any bounds of the number itself."""
    unit: str = ""
    """Unit of the quantity; empty: it has none."""
    scale: float = 1.0
    """Value of the quantity, in its unit, at which the number is 1."""


@dataclass(frozen=True)
class EnvSpec:
    """Static description of an environment: everything that an algorithm gets before the first step."""

    name: str
    """Name in messages, normally the registry name."""
    agents: tuple[str, ...]
    """Names of the N agents in array order, all different. Where agents come and go, these are slots."""
    observation_size: int
    """D, at least 1: every agent's observation is a float32 vector of this length."""
    action_space: ActionSpace
    """Action space, the same for every agent."""
    state_size: int = 0
    """S: length of the global state that central critics read; 0: the environment has none."""
    groups: tuple[str, ...] = ()
    """Group of each agent (a bus line, for instance). Length N, or empty: all agents are in one group. Agents
    of a group are interchangeable: `policies: groups` gives them one policy, and separate policies of a group
    imitate a rule together."""
    shared_reward: bool = False
    """All agents get the team's reward: every slot of `StepResult.rewards` holds it, also slots without a
    live agent. A team's critic then reads one slot."""
    shared_in_groups: bool = False
    """All agents of a group get the group's reward: every slot of the group holds it, also slots without a
    live agent."""
    has_action_mask: bool = False
    """`Observations.action_masks` is given. Not possible for Box actions."""
    agents_come_and_go: bool = False
    """`alive` can be false before the episode ends."""
    metrics: tuple[str, ...] = ()
    """Names of the M episode metrics, all different."""
    max_copies_per_process: int | None = None
    """Maximum number of copies in one process, over all its batches; None: no limit."""
    snapshots: bool = False
    """`snapshot` and `restore` work, so that resuming and collecting again are exact. False: both raise
    HeadwayError."""
    observation_features: tuple[ObservationFeature, ...] = field(default=(), compare=False)
    """The D numbers of an observation in order; empty: the environment does not describe them."""

    @property
    def num_agents(self) -> int:
        """N: number of agents."""
        return len(self.agents)

    @property
    def teams(self) -> tuple[str, ...]:
        """Team of each agent (N,), within which rewards are shared; empty if every agent has its own."""
        if self.shared_reward:
            return ("all",) * self.num_agents
        return self.groups if self.shared_in_groups else ()

    @property
    def for_policies(self) -> "EnvSpec":
        """The specification that algorithms get, with Box actions in the units of `Box.for_policies`."""
        space = self.action_space
        return replace(self, action_space=space.for_policies) if isinstance(space, Box) else self


@dataclass(frozen=True, slots=True)
class Observations:
    """Inputs of the agents of C copies before a step.

    The arrays belong to the environment, which overwrites them at its next step: copy values that are needed
    longer. Rows of agents not alive are unspecified and may contain NaN.
    """

    observations: NDArray[np.float32]
    """(C, N, D): finite where `alive`."""
    states: NDArray[np.float32]
    """(C, S): global states, finite. S is 0 if the environment has none."""
    alive: NDArray[np.bool_]
    """(C, N): alive mask, true where the agent exists now."""
    action_masks: NDArray[np.bool_] | None = None
    """(C, N, A): true where an action is allowed. For a MultiDiscrete space the masks of its choices follow
    one another, so that A is the sum of `nvec`. Every row of a live agent allows at least one action, or one
    option of every choice. None: every action is allowed."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """Result of one step of C copies. The arrays are overwritten at the next step.

    `terminated` and `truncated` are per agent and never both set; where both would apply, the agent is
    terminated. An agent's stream of experience ends where either is set. After termination its return is
    complete; after truncation it continues, estimated from `final_observations`. An agent that is only absent
    for a while (a bus at the depot) is not alive and neither flag is set: its stream continues when it
    returns. A slot whose agent ended may get a new agent, with a new stream, later in the episode.

    When a copy's episode ends, every agent of it must be marked, absent agents included. The copy
    resets itself: the observations that `step` returns with this result are already the first ones of the
    next episode.
    """

    rewards: NDArray[np.float32]
    """(C, N): finite in every slot. Slots without an agent hold the team's or group's reward if it is shared,
    else 0. A reward paid while an agent is absent belongs to its stream."""
    terminated: NDArray[np.bool_]
    """(C, N): the agent's stream ended in a terminal state."""
    truncated: NDArray[np.bool_]
    """(C, N): the agent's stream was cut off, by a time limit for instance."""
    acting: NDArray[np.bool_]
    """(C, N): the environment used the action just given. Implies that the agent was alive before the
    step."""
    episode_ended: NDArray[np.bool_]
    """(C,): the copy's episode ended with this step."""
    final_observations: NDArray[np.float32]
    """(C, N, D): the last observation before any reset. Valid, and finite, exactly where `terminated` or
    `truncated` is set; for an absent agent, its last observation."""
    final_states: NDArray[np.float32]
    """(C, S): the last state before the reset. Valid, and finite, where `episode_ended`."""
    metrics: NDArray[np.float64]
    """(C, M): metrics of the finished episode, in the order of `EnvSpec.metrics`. Valid, and finite, where
    `episode_ended`."""


class BatchedEnv(Protocol):
    """C independent copies of an environment, stepped together; each resets itself when its episode ends.

    `headway.api.CHECKS` are checks of this contract (see `headway.adapters.conformance`).
    """

    @property
    def spec(self) -> EnvSpec:
        """Static description, the same for every number of copies."""
        ...

    @property
    def num_copies(self) -> int:
        """C: number of copies."""
        ...

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        """Begin episode 0 of every copy, `seeds` of shape (C,).

        All randomness in episode i of copy c must follow from (seeds[c], i), independently of other copies.
        """
        ...

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        """Apply actions; return the result and the next observations.

        `actions` is (C, N) int64 for Discrete, (C, N, choices) int64 for MultiDiscrete and (C, N, size)
        float32 for Box spaces, and must not be written to. Actions of agents not alive are ignored.
        """
        ...

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque to the platform
        """Return a value from which `restore` continues bit for bit.

        It is stored in checkpoints and may consist of numpy arrays and scalars, numbers, strings, bytes,
        None, and lists, tuples and dicts of these with strings or numbers as keys. No other object is
        allowed, even if it can be pickled. Raises HeadwayError if `spec.snapshots` is false.
        """
        ...

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401
        """Continue from a snapshot and return the observations at which it was taken.

        Must work on a new environment with the same number of copies, without a reset before. Raises
        HeadwayError if `spec.snapshots` is false.
        """
        ...

    def close(self) -> None:
        """Free the environment's resources. Nothing else is called afterwards."""
        ...


class BranchingEnv(BatchedEnv, Protocol):
    """An environment that can continue from the present states of another batch, as the rule `lookahead`
    needs."""

    def branch_from(
        self, source: BatchedEnv, rows: NDArray[np.int64], seeds: NDArray[np.uint64]
    ) -> Observations:
        """Continue copy c from the present state of copy `rows[c]` of `source`; return the observations.

        `source` is a batch of the same environment and arguments; `rows` and `seeds` are (C,). All later
        randomness must follow from seeds[c]: random events that `source` has drawn in advance must not be
        carried over.
        """
        ...


def step_arrays(spec: EnvSpec, copies: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a batch that steps fill, by name: all zero, except that `masks` allow every
    action."""
    agents, space = (copies, spec.num_agents), spec.action_space
    observations, states = (*agents, spec.observation_size), (copies, spec.state_size)
    return {
        "observations": np.zeros(observations, np.float32),
        "states": np.zeros(states, np.float32),
        "alive": np.zeros(agents, np.bool_),
        "masks": np.ones((*agents, sum(space.options)), np.bool_),
        "rewards": np.zeros(agents, np.float32),
        "acting": np.zeros(agents, np.bool_),
        "terminated": np.zeros(agents, np.bool_),
        "truncated": np.zeros(agents, np.bool_),
        "ended": np.zeros(copies, np.bool_),
        "final_observations": np.zeros(observations, np.float32),
        "final_states": np.zeros(states, np.float32),
        "metrics": np.zeros((copies, len(spec.metrics))),
    }


def step_result(arrays: Mapping[str, NDArray[Any]]) -> StepResult:
    """Return the result of a step whose arrays have the names of `step_arrays`."""
    return StepResult(
        rewards=arrays["rewards"],
        terminated=arrays["terminated"],
        truncated=arrays["truncated"],
        acting=arrays["acting"],
        episode_ended=arrays["ended"],
        final_observations=arrays["final_observations"],
        final_states=arrays["final_states"],
        metrics=arrays["metrics"],
    )

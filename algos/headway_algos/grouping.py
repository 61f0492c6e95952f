"""Assignment of agents to policies, and conversion between arrays by agent and by policy."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec


@dataclass(frozen=True)
class Grouping:
    """K policies over N agents."""

    members: NDArray[np.int64]
    """(K, G): agents of each policy, padded with -1."""

    @classmethod
    def of(cls, policies: str, spec: EnvSpec) -> Self:
        """Return the grouping for a config's `policies`: independent, shared or groups.

        Raises ValueError for any other value.
        """
        agents = np.arange(spec.num_agents)
        if policies == "independent":
            return cls(agents[:, None])
        if policies not in ("shared", "groups"):
            raise ValueError(f"policies must be independent, shared or groups, not {policies!r}")
        if policies == "shared" or not spec.groups:
            return cls(agents[None, :])
        names = list(dict.fromkeys(spec.groups))
        lists = [[n for n in agents if spec.groups[n] == name] for name in names]
        width = max(map(len, lists))
        return cls(np.array([row + [-1] * (width - len(row)) for row in lists]))

    @property
    def num_policies(self) -> int:
        """K: number of policies per replica."""
        return len(self.members)

    @property
    def width(self) -> int:
        """G: agents of the largest group."""
        return len(self.members[0])

    @cached_property
    def is_member(self) -> NDArray[np.bool_]:
        """(K, G): False for padding."""
        return self.members >= 0

    @cached_property
    def _in_order(self) -> bool:
        return bool(np.array_equal(self.members.ravel(), np.arange(self.members.size)))

    @cached_property
    def _slot_of_agent(self) -> NDArray[np.int64]:
        """(N,): index of each agent in the flattened members."""
        flat = self.members.ravel()
        slots = np.empty(int((flat >= 0).sum()), np.int64)
        slots[flat[flat >= 0]] = np.flatnonzero(flat >= 0)
        return slots

    @cached_property
    def _policy_of_agent(self) -> NDArray[np.int64]:
        """(N,): policy of each agent."""
        return self._slot_of_agent // self.width

    def policies(self, copies: int, replicas: int) -> NDArray[np.int64]:
        """Return the policy, of P = R x K, of each agent in each of C copies, (C, N)."""
        first = np.arange(copies) // (copies // replicas) * self.num_policies
        return first[:, None] + self._policy_of_agent

    def owner(self, policy: int, spec: EnvSpec) -> str:
        """Return the owner of policy `policy` of K: "agent bus_3", "group line_1" or "all agents"."""
        members = self.members[policy][self.members[policy] >= 0]
        if self.width == 1:
            return f"agent {spec.agents[members[0]]}"
        return "all agents" if self.num_policies == 1 else f"group {spec.groups[members[0]]}"

    def gather(self, by_agent: NDArray[Any], replicas: int) -> NDArray[Any]:
        """Convert (T, C, N, ...) to (P, G x T x E, ...), rows ordered by agent, then step, then copy.

        Padding repeats an agent's rows; see `is_member`. With a single shared policy, `by_agent` may contain
        the first few agents only.
        """
        steps, copies, agents, *rest = by_agent.shape
        split = by_agent.reshape(steps, replicas, copies // replicas, agents, *rest)
        stacked = split.transpose(1, 3, 0, 2, *range(4, split.ndim))
        if not self._in_order:
            stacked = stacked[:, self.members.ravel()]
        return np.ascontiguousarray(stacked).reshape(replicas * self.num_policies, -1, *rest)

    def scatter(
        self, by_policy: NDArray[Any], replicas: int, steps: int, agents: int | None = None
    ) -> NDArray[Any]:
        """Inverse of `gather`: convert (P, G x T x E, ...) to (T, C, N, ...).

        `agents`: N, if only the first agents were gathered. Raises ValueError if it is given with more than
        one policy.
        """
        if agents is not None and self.num_policies > 1:
            raise ValueError(f"agents must be None with {self.num_policies} policies: all were gathered")
        rest = by_policy.shape[2:]
        slots = self.members.size if agents is None else agents
        stacked = by_policy.reshape(replicas, slots, steps, -1, *rest)
        if not self._in_order:
            stacked = stacked[:, self._slot_of_agent]
        by_agent = stacked.transpose(2, 0, 3, 1, *range(4, stacked.ndim))
        return np.ascontiguousarray(by_agent).reshape(steps, -1, by_agent.shape[3], *rest)

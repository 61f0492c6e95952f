"""Which agent follows which policy, and how arrays by agent become arrays by policy."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec


def missing_groups(policies: str, spec: EnvSpec) -> str | None:
    """Why a config's `policies` cannot be had: one for each group of an environment that names none."""
    if policies == "groups" and not spec.groups:
        return f"{spec.name} names no groups of agents; use algo.policies=shared or algo.policies=independent"
    return None


@dataclass(frozen=True)
class Grouping:
    """K policies over N agents. Policy k's agents are `members[k]`, padded with -1 to G columns."""

    members: NDArray[np.int64]
    """(K, G)"""

    @classmethod
    def of(cls, policies: str, spec: EnvSpec) -> Self:
        """The grouping named by a config's `policies` key: independent, shared or groups.

        Raises ValueError for another word.
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
        """K."""
        return len(self.members)

    @property
    def width(self) -> int:
        """G: agents of the largest group."""
        return len(self.members[0])

    @cached_property
    def is_member(self) -> NDArray[np.bool_]:
        """(K, G): not padding."""
        return self.members >= 0

    @cached_property
    def _in_order(self) -> bool:
        return bool(np.array_equal(self.members.ravel(), np.arange(self.members.size)))

    @cached_property
    def _place(self) -> NDArray[np.int64]:
        """(N,): where each agent stands in the flattened members."""
        flat = self.members.ravel()
        place = np.empty(int((flat >= 0).sum()), np.int64)
        place[flat[flat >= 0]] = np.flatnonzero(flat >= 0)
        return place

    def owner(self, policy: int, spec: EnvSpec) -> str:
        """Whose policy `policy` (of K) is: "agent bus_3", "group line_1" or "all agents"."""
        members = self.members[policy][self.members[policy] >= 0]
        if self.width == 1:
            return f"agent {spec.agents[members[0]]}"
        return "all agents" if self.num_policies == 1 else f"group {spec.groups[members[0]]}"

    def gather(self, by_agent: NDArray[Any], replicas: int) -> NDArray[Any]:
        """(T, C, N, ...) -> (P, G x T x E, ...), rows ordered by agent, then step, then copy.

        Rows of padding repeat some agent's; `is_member` says which they are. Of agents that all share one
        policy there may be the first few only.
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
        """The inverse of `gather`: (P, G x T x E, ...) -> (T, C, N, ...); `agents`: N, where it was fewer
        than all, who share one policy. Raises ValueError for it where there are several."""
        if agents is not None and self.num_policies > 1:
            raise ValueError(f"agents of {self.num_policies} policies are all there: give no number of them")
        rest = by_policy.shape[2:]
        slots = self.members.size if agents is None else agents
        stacked = by_policy.reshape(replicas, slots, steps, -1, *rest)
        if not self._in_order:
            stacked = stacked[:, self._place]
        by_agent = stacked.transpose(2, 0, 3, 1, *range(4, stacked.ndim))
        return np.ascontiguousarray(by_agent).reshape(steps, -1, by_agent.shape[3], *rest)

"""Experience as semi-Markov transitions: from one decision of an agent to its next (or a later) one.

An agent decides at the steps at which its action is used. What it is paid until its next decision, each
step discounted, belongs to the decision before, and the value there is discounted by all the steps between
(Sutton, Precup and Singh 1999, "Between MDPs and semi-MDPs", section 3):

    G = r_t + gamma r_{t+1} + ... + gamma^(k-1) r_{t+k-1},   target = G + gamma^k V(o_{t+k})
"""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Discrete, EnvSpec, Trajectory
from headway_algos.batches.layout import last_known_masks, zero_where_absent

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Transitions:
    """B transitions in the order in which their decisions were taken, those of earlier iterations first."""

    streams: NDArray[np.int64]
    """(B,): copy x N + agent."""
    observations: NDArray[np.float32]
    """(B, D): what was decided on."""
    actions: NDArray[Any]
    """(B,) or (B, A)"""
    returns: Array
    """(B,): rewards until the next observation, discounted."""
    discounts: Array
    """(B,): of the value there: gamma^k after k steps, 0 where the stream terminated."""
    next_observations: NDArray[np.float32]
    """(B, D); zeros where the discount is 0."""
    next_masks: NDArray[np.bool_]
    """(B, A): what is allowed there; the last mask known where the stream was truncated. (B, 0) where the
    environment has no masks."""

    def __len__(self) -> int:
        """B"""
        return len(self.streams)


@dataclass(frozen=True)
class Open:
    """B decisions whose transitions go on in the next iteration."""

    streams: NDArray[np.int64]
    """(B,)"""
    observations: NDArray[np.float32]
    """(B, D)"""
    actions: NDArray[Any]
    """(B,) or (B, A)"""
    returns: Array
    """(B,): so far."""
    discounts: Array
    """(B,): of what comes next."""
    ahead: NDArray[np.int64]
    """(B,): decisions that are still to be looked ahead."""
    masks: NDArray[np.bool_]
    """(B, A): action masks last known; (B, 0) where the environment has none."""

    def where(self, chosen: NDArray[np.bool_]) -> Self:
        """Those chosen, (B,)."""
        return type(self)(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True)
class Links:
    """From each step of each stream to what comes next: its next decision, its end, or the iteration's."""

    returns: Array
    """(T + 1, C, N): rewards from this step until then, discounted."""
    discounts: Array
    """(T + 1, C, N): of the value there; 0 if the stream terminates."""
    places: NDArray[np.int64]
    """(T + 1, C, N): the step of the next decision; T where the iteration ends first; T + 1 + t where the
    stream ends with step t."""

    @classmethod
    def of(
        cls,
        rewards: NDArray[Any],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        decides: NDArray[np.bool_],
        gamma: float,
    ) -> Self:
        """From arrays (T, C, N)."""
        steps = len(rewards)
        over, before_next = terminated | truncated, np.zeros_like(decides)
        before_next[:-1] = decides[1:]
        returns = np.zeros((steps + 1, *rewards.shape[1:]))
        discounts = np.ones_like(returns)
        places = np.full(returns.shape, steps)
        for t in range(steps - 1, -1, -1):
            arrives = over[t] | before_next[t]
            returns[t] = rewards[t] + gamma * np.where(arrives, 0, returns[t + 1])
            discounts[t] = gamma * np.where(arrives, ~terminated[t], discounts[t + 1])
            there = np.where(before_next[t], t + 1, places[t + 1])
            places[t] = np.where(over[t], steps + 1 + t, there)
        return cls(returns, discounts, places)


class TransitionMaker:
    """Turns iterations into transitions; decisions that are open at an iteration's end wait for the next.

    Where an environment cannot be snapshotted, its episodes may start anew between two iterations (on
    resuming): there, open transitions end with the iteration, in what is observed last.
    """

    def __init__(self, spec: EnvSpec, gamma: float, n_step: int) -> None:
        self.spec, self.gamma, self.n_step = spec, gamma, n_step
        self.open: Open | None = None

    def transitions(self, trajectory: Trajectory) -> Transitions:
        """Those that are whole by now."""
        decides = trajectory.alive[:-1] & trajectory.acting
        links = Links.of(trajectory.rewards, trajectory.terminated, trajectory.truncated, decides, self.gamma)
        decisions, places = self._ahead(*self._decisions(trajectory, decides, links), links)
        return self._closed(trajectory, decisions, places)

    def _ahead(
        self, decisions: Open, places: NDArray[np.int64], links: Links
    ) -> tuple[Open, NDArray[np.int64]]:
        """Decisions followed over the next ones, as many as are still to be looked ahead; their places."""
        steps = len(links.places) - 1
        copies, agents = np.divmod(decisions.streams, self.spec.num_agents)
        returns, discounts, ahead = decisions.returns, decisions.discounts, decisions.ahead
        for _ in range(self.n_step):
            at_decision = (places < steps) & (ahead > 0)
            ahead = ahead - at_decision
            onward = at_decision & (ahead > 0)
            here = np.where(onward, places, 0), copies, agents
            returns = np.where(onward, returns + discounts * links.returns[here], returns)
            discounts = np.where(onward, discounts * links.discounts[here], discounts)
            places = np.where(onward, links.places[here], places)
        return replace(decisions, returns=returns, discounts=discounts, ahead=ahead), places

    def _decisions(
        self, trajectory: Trajectory, decides: NDArray[np.bool_], links: Links
    ) -> tuple[Open, NDArray[np.int64]]:
        """Open decisions, then this iteration's, each followed to its next place: (B,)."""
        step, copies, agents = rows = np.nonzero(decides)
        new = Open(
            copies * self.spec.num_agents + agents,
            trajectory.observations[rows],
            trajectory.actions[rows],
            links.returns[rows],
            links.discounts[rows],
            np.full(len(step), self.n_step),
            trajectory.action_masks[rows] if self.spec.has_action_mask else np.ones((len(step), 0), np.bool_),
        )
        places = links.places[rows]
        if self.open is None:
            return new, places
        old = self.open
        first = (np.zeros_like(old.streams), *np.divmod(old.streams, self.spec.num_agents))
        at_once = decides[first]
        returns = old.returns + np.where(at_once, 0, old.discounts * links.returns[first])
        discounts = old.discounts * np.where(at_once, 1, links.discounts[first])
        followed = replace(old, returns=returns, discounts=discounts)
        both = (np.concatenate([getattr(x, field.name) for x in (followed, new)]) for field in fields(Open))
        return Open(*both), np.concatenate([np.where(at_once, 0, links.places[first]), places])

    def _closed(self, trajectory: Trajectory, decisions: Open, places: NDArray[np.int64]) -> Transitions:
        """Those that arrived, with what is observed there; the others are open from now on."""
        steps = len(trajectory.actions)
        copies, agents = np.divmod(decisions.streams, self.spec.num_agents)
        waits, ends = places == steps, places > steps
        last_steps = np.where(ends, places - steps - 1, steps - 1)
        if self.spec.has_action_mask:
            masks = last_known_masks(trajectory, (last_steps, copies, agents), decisions.masks)
            decisions = replace(decisions, masks=masks)
        if self.spec.snapshots:
            self.open, whole = decisions.where(waits), ~waits
        else:
            whole = ~waits | trajectory.alive[-1, copies, agents]
        places, copies, agents, ends = places[whole], copies[whole], agents[whole], ends[whole]
        streams_end = last_steps[whole], copies, agents
        goes_on = np.where(ends, 0, places), copies, agents
        last, on = trajectory.final_observations[streams_end], trajectory.observations[goes_on]
        discounts = decisions.discounts[whole]
        masks = decisions.masks[whole]
        if self.spec.has_action_mask:
            masks = np.where(ends[:, None], masks, trajectory.action_masks[goes_on])
        return Transitions(
            decisions.streams[whole],
            decisions.observations[whole],
            decisions.actions[whole],
            decisions.returns[whole],
            discounts,
            zero_where_absent(np.where(ends[:, None], last, on), discounts > 0),
            masks,
        )

    def state_dict(self) -> dict[str, Any]:
        """The open decisions; empty where there are none."""
        return {} if self.open is None else {f.name: getattr(self.open, f.name) for f in fields(Open)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; takes the state of versions that kept no masks as well."""
        if not state:
            self.open = None
            return
        space, masked = self.spec.action_space, self.spec.has_action_mask
        options = space.n if masked and isinstance(space, Discrete) else 0
        self.open = Open(**{"masks": np.ones((len(state["streams"]), options), np.bool_), **state})

"""Semi-Markov transitions: from one decision of an agent to its next, or n-th next, decision.

An agent makes a decision at each step at which the environment uses its action. The discounted rewards until
the next decision are credited to it, and the value there is discounted by the number k of steps between
(Sutton, Precup and Singh 1999, "Between MDPs and semi-MDPs", section 3):

    G = r_t + gamma r_{t+1} + ... + gamma^(k-1) r_{t+k-1},   target = G + gamma^k V(o_{t+k})

With a shared reward, the return of an agent that has left continues with its team's rewards until the episode
ends. If the episode is truncated, the target bootstraps from the agent's own last observation.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory
from headway_algos.batches.layout import zero_where_absent
from headway_algos.batches.stream_ends import last_known_masks, return_ends

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Transitions:
    """B transitions in the order of their decisions, those of earlier iterations first."""

    streams: NDArray[np.int64]
    """(B,): copy x N + agent."""
    observations: NDArray[np.float32]
    """(B, D): observations at the decisions."""
    actions: NDArray[Any]
    """(B,) for Discrete, (B, A) for Box"""
    returns: Array
    """(B,): discounted rewards G until the next observation."""
    discounts: Array
    """(B,): discount of the next value, gamma^k after k steps; 0 where the stream terminated."""
    next_observations: NDArray[np.float32]
    """(B, D): observations to bootstrap from; zeros where the discount is 0."""
    next_masks: NDArray[np.bool_]
    """(B, A): action masks at the next observations; where the stream was truncated, the last known mask.
    (B, 0) if the environment has no masks."""

    def __len__(self) -> int:
        """B: number of transitions."""
        return len(self.streams)


@dataclass(frozen=True)
class OpenDecisions:
    """B decisions whose transitions continue in the next iteration."""

    streams: NDArray[np.int64]
    """(B,): copy x N + agent."""
    observations: NDArray[np.float32]
    """(B, D): observations at the decisions."""
    actions: NDArray[Any]
    """(B,) for Discrete, (B, A) for Box"""
    returns: Array
    """(B,): discounted rewards so far."""
    discounts: Array
    """(B,): discount of the next reward or value."""
    ahead: NDArray[np.int64]
    """(B,): number of further decisions until the transition is complete."""
    masks: NDArray[np.bool_]
    """(B, A): the last known action masks; (B, 0) if the environment has none."""

    def where(self, chosen: NDArray[np.bool_]) -> Self:
        """Return the decisions selected by the mask `chosen` (B,)."""
        return type(self)(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True)
class Spans:
    """Spans from each step of each stream to its next decision, its end, or the end of the iteration."""

    returns: Array
    """(T + 1, C, N): discounted rewards over the span."""
    discounts: Array
    """(T + 1, C, N): discount of the value at the end of the span; 0 if the stream terminates there."""
    ends: NDArray[np.int64]
    """(T + 1, C, N): step of the next decision; T if the iteration ends first; T + 1 + t if the stream ends
    with step t."""

    @classmethod
    def of(
        cls,
        rewards: NDArray[Any],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        decides: NDArray[np.bool_],
        gamma: float,
    ) -> Self:
        """Compute spans backwards in time, given arrays (T, C, N)."""
        steps = len(rewards)
        over, before_next = terminated | truncated, np.zeros_like(decides)
        before_next[:-1] = decides[1:]
        returns = np.zeros((steps + 1, *rewards.shape[1:]))
        discounts = np.ones_like(returns)
        ends = np.full(returns.shape, steps)
        for t in range(steps - 1, -1, -1):
            # The span of step t ends with this step if the stream ends or the agent decides at t + 1.
            arrives = over[t] | before_next[t]
            returns[t] = rewards[t] + gamma * np.where(arrives, 0, returns[t + 1])
            discounts[t] = gamma * np.where(arrives, ~terminated[t], discounts[t + 1])
            next_end = np.where(before_next[t], t + 1, ends[t + 1])
            ends[t] = np.where(over[t], steps + 1 + t, next_end)
        return cls(returns, discounts, ends)


class TransitionBuilder:
    """Converts trajectories to transitions; decisions open at the end of an iteration continue in the next.

    Without snapshots (`EnvSpec.snapshots`), episodes may restart between iterations when a run is resumed.
    Open transitions then end with the iteration and bootstrap from the agent's last observation, even if the
    agent is absent by then: dropping them would select against long absences.
    """

    def __init__(self, spec: EnvSpec, gamma: float, n_step: int) -> None:
        self.spec, self.gamma, self.n_step = spec, gamma, n_step
        self.open: OpenDecisions | None = None

    def transitions(self, trajectory: Trajectory) -> Transitions:
        """Return the transitions that this trajectory completes."""
        decides = trajectory.alive[:-1] & trajectory.acting
        spans = Spans.of(trajectory.rewards, *return_ends(trajectory, self.spec), decides, self.gamma)
        decisions, ends = self._extend(*self._decisions(trajectory, decides, spans), spans)
        return self._close(trajectory, decisions, ends)

    def _extend(
        self, decisions: OpenDecisions, ends: NDArray[np.int64], spans: Spans
    ) -> tuple[OpenDecisions, NDArray[np.int64]]:
        """Extend decisions over up to `ahead` further spans; return them with the ends reached."""
        steps = len(spans.ends) - 1
        copies, agents = np.divmod(decisions.streams, self.spec.num_agents)
        returns, discounts, ahead = decisions.returns, decisions.discounts, decisions.ahead
        for _ in range(self.n_step):
            # Each decision reached uses up one of `ahead`; after the last one the transition is complete.
            at_decision = (ends < steps) & (ahead > 0)
            ahead = ahead - at_decision
            extended = at_decision & (ahead > 0)
            span = np.where(extended, ends, 0), copies, agents
            returns = np.where(extended, returns + discounts * spans.returns[span], returns)
            discounts = np.where(extended, discounts * spans.discounts[span], discounts)
            ends = np.where(extended, spans.ends[span], ends)
        return replace(decisions, returns=returns, discounts=discounts, ahead=ahead), ends

    def _decisions(
        self, trajectory: Trajectory, decides: NDArray[np.bool_], spans: Spans
    ) -> tuple[OpenDecisions, NDArray[np.int64]]:
        """Return open decisions, then new ones, each extended by one span, and their ends (B,)."""
        step, copies, agents = rows = np.nonzero(decides)
        new = OpenDecisions(
            copies * self.spec.num_agents + agents,
            trajectory.observations[rows],
            trajectory.actions[rows],
            spans.returns[rows],
            spans.discounts[rows],
            np.full(len(step), self.n_step),
            trajectory.action_masks[rows] if self.spec.has_action_mask else np.ones((len(step), 0), np.bool_),
        )
        ends = spans.ends[rows]
        if self.open is None:
            return new, ends
        old = self.open
        first = (np.zeros_like(old.streams), *np.divmod(old.streams, self.spec.num_agents))
        # A decision at step 0 ends the open span right there, with no further reward.
        at_once = decides[first]
        returns = old.returns + np.where(at_once, 0, old.discounts * spans.returns[first])
        discounts = old.discounts * np.where(at_once, 1, spans.discounts[first])
        extended = replace(old, returns=returns, discounts=discounts)
        both = (
            np.concatenate([getattr(x, field.name) for x in (extended, new)])
            for field in fields(OpenDecisions)
        )
        return OpenDecisions(*both), np.concatenate([np.where(at_once, 0, spans.ends[first]), ends])

    def _close(
        self, trajectory: Trajectory, decisions: OpenDecisions, ends: NDArray[np.int64]
    ) -> Transitions:
        """Return the completed transitions; keep the others open."""
        steps = len(trajectory.actions)
        copies, agents = np.divmod(decisions.streams, self.spec.num_agents)
        continues, stream_ended = ends == steps, ends > steps
        last_step = np.where(stream_ended, ends - steps - 1, steps - 1)
        if self.spec.has_action_mask:
            masks = last_known_masks(trajectory, (last_step, copies, agents), decisions.masks)
            decisions = replace(decisions, masks=masks)
        # A transition that the iteration cuts off can bootstrap only from what the agent observed last.
        last_seen = steps - trajectory.alive[::-1].argmax(axis=0)
        ends = np.where(continues, last_seen[copies, agents], ends)
        complete = np.ones_like(continues)
        if self.spec.snapshots:
            self.open, complete = decisions.where(continues), ~continues
        ends, copies, agents = ends[complete], copies[complete], agents[complete]
        stream_ended = stream_ended[complete]
        final_step = last_step[complete], copies, agents
        next_step = np.where(stream_ended, 0, ends), copies, agents
        final, following = trajectory.final_observations[final_step], trajectory.observations[next_step]
        discounts, masks = decisions.discounts[complete], decisions.masks[complete]
        if self.spec.has_action_mask:
            masks = np.where(stream_ended[:, None], masks, trajectory.action_masks[next_step])
        return Transitions(
            decisions.streams[complete],
            decisions.observations[complete],
            decisions.actions[complete],
            decisions.returns[complete],
            discounts,
            zero_where_absent(np.where(stream_ended[:, None], final, following), discounts > 0),
            masks,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the open decisions; empty if there are none."""
        return (
            {} if self.open is None else {f.name: getattr(self.open, f.name) for f in fields(OpenDecisions)}
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`, also of versions that kept no masks."""
        if not state:
            self.open = None
            return
        options = sum(self.spec.action_space.options) if self.spec.has_action_mask else 0
        unmasked = np.ones((len(state["streams"]), options), np.bool_)
        self.open = OpenDecisions(**{"masks": unmasked, **state})

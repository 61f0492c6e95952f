"""Semi-Markov transitions against a walk along each agent's stream."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from covering import pairwise
from made_trajectories import end_episodes, fabricate, poisoned
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, Trajectory
from headway_algos.off_policy.transitions import TransitionBuilder, Transitions

GAMMA = 0.9
SPEC = EnvSpec(
    "made", ("a", "b", "c"), 3, Discrete(4), has_action_mask=True, agents_come_and_go=True, snapshots=True
)
TEAM = replace(SPEC, shared_reward=True)
TEAMS = replace(SPEC, shared_in_groups=True, groups=("x", "y", "x"))
Row = tuple[int, NDArray[Any], Any, float, float, NDArray[Any], NDArray[np.bool_]]
"""stream, observation, action, return, discount, next observation, next mask"""


def _walk(
    parts: list[Trajectory], n_step: int, stream: int, start: tuple[int, int], team: bool
) -> Row | None:
    """The transition of the decision at `start` (iteration, step), or None where it is not yet whole.

    A team's return ends with the episode, for all of the team.
    """
    agents = parts[0].rewards.shape[2]
    c, n = divmod(stream, agents)
    steps = [(i, t) for i, part in enumerate(parts) for t in range(len(part.rewards))]
    first = parts[start[0]]
    taken = first.observations[start[1], c, n], first.actions[start[1], c, n]
    total, discount, ahead = 0.0, 1.0, n_step
    for i, t in steps[steps.index(start) :]:
        part = parts[i]
        if part.alive[t, c, n]:
            allowed = part.action_masks[t, c, n]  # the last that is known, until the agent is seen again
        if (i, t) != start and part.alive[t, c, n] and part.acting[t, c, n]:
            ahead -= 1
            if ahead == 0:
                return stream, *taken, total, discount, part.observations[t, c, n], part.action_masks[t, c, n]
        total += discount * float(part.rewards[t, c, n])
        discount *= GAMMA
        if team and not (part.terminated[t, c] | part.truncated[t, c]).all():
            continue
        if part.terminated[t, c].all() if team else part.terminated[t, c, n]:
            return stream, *taken, total, 0.0, np.zeros(part.observations.shape[-1]), allowed
        if team or part.truncated[t, c, n]:
            return stream, *taken, total, discount, part.final_observations[t, c, n], allowed
    return None


def _all_walks(parts: list[Trajectory], n_step: int, team: bool = False) -> list[Row]:
    _, copies, agents = parts[0].rewards.shape
    decided = [
        (c * agents + n, (i, t))
        for c in range(copies)
        for n in range(agents)
        for i, part in enumerate(parts)
        for t in range(len(part.rewards))
        if part.alive[t, c, n] and part.acting[t, c, n]
    ]
    walked = (_walk(parts, n_step, stream, start, team) for stream, start in decided)
    return [row for row in walked if row is not None]


def _rows(made: list[Transitions]) -> list[Row]:
    """Return the transitions by stream, each stream in order of time."""
    rows = [
        (
            int(part.streams[i]), part.observations[i], part.actions[i], float(part.returns[i]),
            float(part.discounts[i]), part.next_observations[i], part.next_masks[i],
        )
        for part in made
        for i in range(len(part))
    ]  # fmt: skip
    return sorted(rows, key=lambda row: row[0])


def _key(row: Row) -> tuple[Any, ...]:
    return (row[0], *row[1].tolist())


def _assert_same(got: list[Row], expected: list[Row]) -> None:
    """Ignores the order within a stream: an n-step transition can be complete before an earlier one."""
    assert len(got) == len(expected)
    for mine, theirs in zip(sorted(got, key=_key), sorted(expected, key=_key), strict=True):
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("n_step", "spec", "idle"), pairwise([1, 2, 5], [SPEC, TEAM, TEAMS], [0.0, 0.6]))
def test_transitions_are_those_of_a_walk_along_each_stream(n_step: int, idle: float, spec: EnvSpec) -> None:
    """Over three iterations, with agents absent, idle, truncated and terminated, singly and together."""
    parts = [fabricate(spec, 7, 4, seed=i, absent=0.3, idle=idle, ends=0.1, leaves=0.05) for i in range(3)]
    for part in parts:
        part.truncated[6, 0], part.terminated[6, 0] = [True, False, False], [False, True, True]
        part.terminated[5, 1], part.truncated[5, 1] = True, False
        end_episodes(part)
    builder = TransitionBuilder(spec, GAMMA, n_step)
    made = [builder.transitions(part) for part in parts]
    expected = _all_walks(parts, n_step, team=spec is not SPEC)
    assert len(expected) > 30
    assert any(row[4] == 0 for row in expected)
    assert any(0 < row[4] < GAMMA**3 for row in expected)
    _assert_same(_rows(made), expected)


def test_rows_without_experience_are_never_read() -> None:
    made = fabricate(SPEC, 12, 4, seed=3, absent=0.3, idle=0.3, ends=0.2, leaves=0.1)
    clean, bad = (TransitionBuilder(SPEC, GAMMA, 2).transitions(part) for part in (made, poisoned(made)))
    assert len(clean) > 20
    for name in Transitions.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(bad, name), getattr(clean, name))
    assert np.isfinite(bad.observations).all()
    assert np.isfinite(bad.next_observations).all()


def test_without_snapshots_transitions_end_with_the_iteration() -> None:
    """They end at the agent's last observation, and none stays open."""
    spec = replace(SPEC, snapshots=False)
    made = fabricate(spec, 6, 5, seed=2, absent=0.3, idle=0.5, ends=0.0)
    builder = TransitionBuilder(spec, GAMMA, 1)
    transitions = builder.transitions(made)
    assert builder.state_dict() == {}
    walked = _all_walks([made], 1)
    assert len(transitions) > len(walked)
    assert len(transitions) == (made.alive[:-1] & made.acting).sum()
    checked = 0
    for i, stream in enumerate(transitions.streams.tolist()):
        copy, agent = divmod(stream, 3)
        decisions = np.flatnonzero(made.alive[:-1, copy, agent] & made.acting[:, copy, agent])
        last = decisions[-1]
        if (transitions.observations[i] != made.observations[last, copy, agent]).any():
            continue
        seen = np.flatnonzero(made.alive[:, copy, agent])[-1]
        np.testing.assert_array_equal(transitions.next_observations[i], made.observations[seen, copy, agent])
        np.testing.assert_array_equal(transitions.next_masks[i], made.action_masks[seen, copy, agent])
        assert transitions.discounts[i] == pytest.approx(GAMMA ** (6 - last))
        paid = (made.rewards[last:, copy, agent] * GAMMA ** np.arange(6 - last)).sum()
        assert transitions.returns[i] == pytest.approx(paid, rel=1e-5)
        checked += 1
    assert checked == len(transitions) - len(walked)


def test_open_decisions_are_kept_in_the_state() -> None:
    """Also from a state stored before masks were kept."""
    parts = [fabricate(SPEC, 5, 4, seed=i, absent=0.3, idle=0.6) for i in range(2)]
    builder, other, later = (TransitionBuilder(SPEC, GAMMA, 2) for _ in range(3))
    builder.transitions(parts[0])
    state = builder.state_dict()
    assert len(state["streams"]) > 3
    other.load_state_dict(state)
    later.load_state_dict({name: value for name, value in state.items() if name != "masks"})
    continued, restored, upgraded = (each.transitions(parts[1]) for each in (builder, other, later))
    for name in Transitions.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(restored, name), getattr(continued, name))
    np.testing.assert_array_equal(upgraded.returns, continued.returns)
    assert (upgraded.next_masks >= continued.next_masks).all()


def test_box_actions_are_stored_with_all_components() -> None:
    spec = replace(SPEC, action_space=Box((-1.0, -1.0), (1.0, 1.0)), has_action_mask=False)
    made = fabricate(spec, 6, 2, seed=0)
    transitions = TransitionBuilder(spec, GAMMA, 1).transitions(made)
    assert transitions.actions.shape == (len(transitions), 2)
    assert transitions.next_masks.shape == (len(transitions), 0)


@pytest.mark.parametrize("away", [0, 2, 7])
def test_actions_never_allowed_are_not_allowed_at_a_time_limit_either(away: int) -> None:
    """This includes agents that have been absent for some steps when their stream is cut, possibly since an
    earlier iteration."""
    parts = [fabricate(SPEC, 5, 3, seed=i, ends=0.0) for i in range(2)]
    for part in parts:
        part.action_masks[..., 1], part.action_masks[..., 0] = False, True
        part.actions[:] = 0
    parts[1].truncated[-1] = parts[1].episode_ended[-1] = True
    for i, part in enumerate(parts):
        still_there = np.arange(5 * i, 5 * i + 6) < 10 - away
        part.alive[:] &= still_there[:, None, None]
        part.acting[:] = part.alive[:-1]
        part.action_masks[~part.alive] = True  # rows of agents not alive may hold anything
    builder = TransitionBuilder(SPEC, GAMMA, 1)
    made = [builder.transitions(part) for part in parts]
    assert len(made[0]) + len(made[1]) == 9 * (10 - away)
    assert made[1].discounts.min() == pytest.approx(GAMMA ** (away + 1))
    assert not any(part.next_masks[:, 1].any() for part in made)

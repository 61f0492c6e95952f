"""Recordings of random play, and their comparison bit for bit."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import (
    BatchedEnv,
    Box,
    EnvSpec,
    Observations,
    Trajectory,
    TrajectoryLayout,
    generator,
)
from headway.contracts.random_rule import random_actions
from headway.rollout.nan_check import check_finite

_OBSERVED = ("observations", "states", "alive", "action_masks")
_RESULTS = (
    "rewards", "terminated", "truncated", "acting", "episode_ended", "final_observations", "final_states",
)  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """T steps of random play: a trajectory, and the metrics of its episodes."""

    spec: EnvSpec
    """Environment that was played."""
    trajectory: Trajectory
    """Trajectory of T steps. Its `log_probs` are 0."""
    metrics: NDArray[np.float64]
    """(T, C, M): valid where `episode_ended`."""

    @property
    def episode_ended(self) -> NDArray[np.bool_]:
        """(T, C): the copy's episode ended with the step."""
        return self.trajectory.episode_ended

    @property
    def steps(self) -> int:
        """Number of steps, T."""
        return len(self.episode_ended)

    @property
    def copies(self) -> int:
        """Number of copies, C."""
        return int(self.episode_ended.shape[1])

    def of_copy(self, copy: int, first: int = 0, steps: int | None = None) -> "Recording":
        """Return steps first to first + steps - 1 of one copy; `steps` None: all from `first` on."""
        last = self.steps if steps is None else first + steps
        return Recording(
            self.spec,
            _between(self.trajectory.of_copies(copy, 1), first, last),
            self.metrics[first:last, copy : copy + 1],
        )


class RandomPlay:
    """Uniformly random allowed actions.

    A copy's actions depend only on its seed and on the number of calls before.
    """

    def __init__(self, seeds: NDArray[np.uint64]) -> None:
        self._generators = [generator(int(seed), "random play") for seed in seeds]

    def act(self, spec: EnvSpec, observed: Observations) -> NDArray[Any]:
        """Return actions as `BatchedEnv.step` takes them; Box bounds are clipped to [-10, 10]."""
        space, agents, masks = spec.action_space, (spec.num_agents,), observed.action_masks
        if isinstance(space, Box):
            low, high = np.clip((space.low, space.high), -10, 10).tolist()
            space = Box(tuple(low), tuple(high))
        of_copies = [None] * len(self._generators) if masks is None else masks
        drawn = zip(self._generators, of_copies, strict=True)
        return np.stack([random_actions(space, draw, agents, mask) for draw, mask in drawn])


def record(
    env: BatchedEnv, observed: Observations, play: RandomPlay, max_steps: int, episodes: int
) -> Recording:
    """Return a recording of at most `max_steps` steps from `observed` on.

    Stops earlier once every copy has ended `episodes` episodes. Raises AssertionError if a shape or dtype
    breaks the contract, and HeadwayError if a value that must be finite is not.
    """
    spec, copies = env.spec, env.num_copies
    track = Trajectory.allocate(TrajectoryLayout(spec, max_steps, copies))
    metrics = np.zeros((max_steps, copies, len(spec.metrics)))
    check_finite(spec, None, observed, step=0)
    _store_observed(track, 0, observed)
    steps = 0
    while steps < max_steps and (track.episode_ended.sum(axis=0) < episodes).any():
        actions = play.act(spec, observed)
        track.actions[steps] = actions
        outcome, observed = env.step(actions)
        assert np.array_equal(track.actions[steps], actions), "step must not write to the actions it is given"
        check_finite(spec, outcome, observed, step=steps + 1)
        for name in _RESULTS:
            _store(getattr(track, name)[steps], getattr(outcome, name), name)
        _store(metrics[steps], outcome.metrics, "metrics")
        steps += 1
        _store_observed(track, steps, observed)
    return Recording(spec, _between(track, 0, steps), metrics[:steps])


def assert_same(one: Recording, other: Recording) -> None:
    """Raise AssertionError unless both recordings agree bit for bit where the contract defines values."""
    assert one.steps == other.steps, f"{one.steps} steps, not {other.steps}"
    mine, theirs = one.trajectory, other.trajectory
    for name in ("states", "alive", "rewards", "terminated", "truncated", "acting", "episode_ended"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), name)
    over = mine.terminated | mine.truncated
    compared = [
        ("observations", mine.alive),
        ("final_observations", over),
        ("final_states", one.episode_ended),
    ]
    if one.spec.has_action_mask:
        compared.append(("action_masks", mine.alive))
    for name, rows in compared:
        np.testing.assert_array_equal(getattr(mine, name)[rows], getattr(theirs, name)[rows], name)
    np.testing.assert_array_equal(one.metrics[one.episode_ended], other.metrics[one.episode_ended], "metrics")


def _between(trajectory: Trajectory, first: int, last: int) -> Trajectory:
    """Return steps first to last - 1 of a trajectory, with the observations that follow."""
    names = [field.name for field in fields(trajectory)]
    return Trajectory(
        **{name: getattr(trajectory, name)[first : last + 1 if name in _OBSERVED else last] for name in names}
    )


def _store_observed(track: Trajectory, step: int, observed: Observations) -> None:
    for name in ("observations", "states", "alive"):
        _store(getattr(track, name)[step], getattr(observed, name), name)
    if len(track.action_masks):
        assert observed.action_masks is not None, "the spec declares action masks, but there are none"
        _store(track.action_masks[step], observed.action_masks, "action_masks")
    else:
        assert observed.action_masks is None, "there are action masks that the spec does not declare"


def _store(out: NDArray[Any], value: NDArray[Any], name: str) -> None:
    """Copy `value` to `out`. Raises AssertionError if shape or dtype differ."""
    assert value.dtype == out.dtype, f"{name} is {value.dtype}, not {out.dtype}"
    assert value.shape == out.shape, f"{name} has shape {value.shape}, not {out.shape}"
    out[...] = value

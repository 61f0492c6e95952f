"""Checks of the `BatchedEnv` contract for any environment, including those of third parties.

    from headway.api import CHECKS, play

    recording = play(make)
    for check in CHECKS.values():
        check(make, recording)

Each check raises AssertionError saying what was broken.
"""

import pickle
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.adapters.recording import RandomPlay, Recording, assert_same, record
from headway.contracts import BatchedEnv, HeadwayError
from headway.contracts.spaces import allows_action
from headway.store.checkpoint import load_latest, save_checkpoint

Make = Callable[[int], BatchedEnv]
"""(copies) -> environment."""
Check = Callable[[Make, Recording], None]
"""(make, recording of `play(make)`) -> None. Raises AssertionError if the contract is broken."""

COPIES = 3
"""Default number of copies, or fewer if a process can hold fewer."""
FIRST_SEED = 5
"""Seed of the first copy of a recording."""
MAX_STEPS = 1500
"""Default length of a recording in steps; it ends earlier once every copy has ended two episodes."""


def seeds_from(first: int, count: int) -> NDArray[np.uint64]:
    """Return seeds first to first + count - 1, shape (count,)."""
    return np.arange(first, first + count, dtype=np.uint64)


def play(
    make: Make, copies: int | None = None, first_seed: int = FIRST_SEED, max_steps: int = MAX_STEPS
) -> Recording:
    """Return a recording of random play from `reset`; shapes, dtypes and values are checked at each step.

    `copies` None: COPIES, or as many as a process can hold. Copy c has seed first_seed + c. Raises as
    `record` does.
    """
    if copies is None:
        with closing(make(1)) as first:
            copies = min(COPIES, first.spec.max_copies_per_process or COPIES)
    env, seeds = make(copies), seeds_from(first_seed, copies)
    recording = record(env, env.reset(seeds), RandomPlay(seeds), max_steps, episodes=2)
    env.close()
    return recording


def check_spec(make: Make, recording: Recording) -> None:
    """Check that names are unique, groups complete and sizes positive, for any number of copies."""
    spec = recording.spec
    assert len(set(spec.agents)) == spec.num_agents > 0, "agents need different names"
    assert len(spec.groups) in (0, spec.num_agents), "groups must name each agent's group, or be empty"
    assert len(set(spec.metrics)) == len(spec.metrics), "metrics need different names"
    assert spec.observation_size > 0, "observations need at least one component"
    features = [feature.name for feature in spec.observation_features]
    assert len(features) in (0, spec.observation_size), (
        "observation_features must name each number, or be empty"
    )
    assert len(set(features)) == len(features), "observation_features need different names"
    copies = min(recording.copies, 2)
    env = make(copies)
    assert env.num_copies == copies, "num_copies is not the number requested"
    assert env.spec == spec, "the spec must not depend on the number of copies"
    env.close()


def check_alive(make: Make, recording: Recording) -> None:
    """Check that only live agents act, and that all are alive if agents do not come and go."""
    spec, track = recording.spec, recording.trajectory
    assert not (track.acting & ~track.alive[:-1]).any(), "an agent acted without being alive"
    if not spec.agents_come_and_go:
        assert track.alive.all(), "an agent is not alive, but the spec has agents_come_and_go false"


def check_ends(make: Make, recording: Recording) -> None:
    """Check that the end of an episode either terminates or truncates every agent's stream."""
    track, ended = recording.trajectory, recording.episode_ended
    assert not (track.terminated & track.truncated).any(), "terminated and truncated are both set"
    over = track.terminated | track.truncated
    assert over[ended].all(), "an episode ended, but an agent is neither terminated nor truncated"
    if not recording.spec.agents_come_and_go:
        assert (over.any(axis=-1) == ended).all(), "an agent's stream ended before the episode did"
    assert np.isfinite(recording.metrics[ended]).all(), "an episode's metrics are not finite"


def check_masks(make: Make, recording: Recording) -> None:
    """Check that every live agent has an allowed action."""
    track = recording.trajectory
    if recording.spec.has_action_mask:
        assert allows_action(recording.spec.action_space, track.action_masks)[track.alive].all(), (
            "a live agent has no allowed action"
        )


def check_shared_reward(make: Make, recording: Recording) -> None:
    """Check that a reward shared by all agents or a group is equal in the slots of all of them.

    Absent agents are included. Raises AssertionError.
    """
    rewards, spec = recording.trajectory.rewards, recording.spec
    if spec.shared_reward:
        assert (rewards == rewards[..., :1]).all(), "shared_reward is true, but rewards differ"
    if spec.shared_in_groups:
        assert spec.groups, "shared_in_groups is true, but there are no groups"
        firsts = [spec.groups.index(group) for group in spec.groups]
        assert (rewards == rewards[..., firsts]).all(), (
            "shared_in_groups is true, but rewards differ within a group"
        )


def check_determinism(make: Make, recording: Recording) -> None:
    """Check that equal seeds and actions give equal results, in a new environment and after `reset`."""
    copies = recording.copies
    env, seeds = make(copies), seeds_from(FIRST_SEED, copies)
    others = seeds_from(FIRST_SEED + 100, copies)
    record(env, env.reset(others), RandomPlay(others), max_steps=7, episodes=2)
    assert_same(recording, record(env, env.reset(seeds), RandomPlay(seeds), MAX_STEPS, episodes=2))
    env.close()


def check_copies(make: Make, recording: Recording) -> None:
    """Check that a copy does not depend on the other copies, in its first and in later episodes."""
    for copy in range(recording.copies):
        alone = play(make, copies=1, first_seed=FIRST_SEED + copy)
        assert_same(alone, recording.of_copy(copy, steps=alone.steps))


def check_snapshots(make: Make, recording: Recording) -> None:
    """Check that a snapshot stored in a checkpoint continues bit for bit, within an episode and past its end.

    Without `spec.snapshots`, check that `snapshot` raises HeadwayError.
    """
    copies = recording.copies
    seeds = seeds_from(FIRST_SEED, copies)
    env = make(copies)
    random_play = RandomPlay(seeds)
    before = record(env, env.reset(seeds), random_play, max_steps=max(recording.steps // 3, 1), episodes=2)
    if not recording.spec.snapshots:
        try:
            env.snapshot()
        except HeadwayError:
            return
        finally:
            env.close()
        raise AssertionError("snapshots is false in the spec, but snapshot() does not raise HeadwayError")
    snapshot, play_copy = _checkpoint_round_trip(env.snapshot()), pickle.loads(pickle.dumps(random_play))
    continued = record(env, env.restore(env.snapshot()), random_play, MAX_STEPS, episodes=2)
    env.close()
    other = make(copies)
    observed = other.restore(snapshot)
    np.testing.assert_array_equal(observed.alive, before.trajectory.alive[-1], "alive")
    assert_same(continued, record(other, observed, play_copy, MAX_STEPS, episodes=2))
    for copy in range(copies):
        rest = min(continued.steps, recording.steps - before.steps)
        assert_same(continued.of_copy(copy, steps=rest), recording.of_copy(copy, before.steps, rest))
    other.close()


def _checkpoint_round_trip(snapshot: Any) -> Any:  # noqa: ANN401 - opaque to the platform
    """Return the snapshot as a checkpoint file restores it."""
    with TemporaryDirectory() as folder:
        try:
            save_checkpoint(Path(folder), 0, {"snapshot": snapshot})
        except ValueError as error:
            raise AssertionError(f"a checkpoint cannot hold the snapshot: {error}") from error
        return load_latest(Path(folder))[1]["snapshot"]


CHECKS: Mapping[str, Check] = {
    "spec": check_spec,
    "alive": check_alive,
    "ends": check_ends,
    "masks": check_masks,
    "shared reward": check_shared_reward,
    "determinism": check_determinism,
    "copies": check_copies,
    "snapshots": check_snapshots,
}
"""All checks by name."""

"""What `BatchedEnv` promises, as checks that anybody can run over an environment of their own.

    recording = play(make)
    for check in CHECKS.values():
        check(make, recording)

Each check raises AssertionError with what was broken.
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
from headway.store.checkpoint import load_latest, save_checkpoint

Make = Callable[[int], BatchedEnv]
"""(copies) -> environment."""
Check = Callable[[Make, Recording], None]

COPIES = 3
"""Or as many as the environment allows in a process."""
FIRST_SEED = 5
LONGEST = 1500
"""Steps of a recording, unless every copy has ended two episodes before."""


def seeds_from(first: int, count: int) -> NDArray[np.uint64]:
    """Seeds first to first + count - 1: (count,)."""
    return np.arange(first, first + count, dtype=np.uint64)


def play(
    make: Make, copies: int | None = None, first_seed: int = FIRST_SEED, longest: int = LONGEST
) -> Recording:
    """Random play from `reset`, with shapes, types and numbers checked at each step; `copies` None: COPIES,
    or as many as the environment allows."""
    if copies is None:
        with closing(make(1)) as first:
            copies = min(COPIES, first.spec.max_copies_per_process or COPIES)
    env, seeds = make(copies), seeds_from(first_seed, copies)
    recording = record(env, env.reset(seeds), RandomPlay(seeds), longest, episodes=2)
    env.close()
    return recording


def check_spec(make: Make, recording: Recording) -> None:
    """Names are unique, groups are complete, sizes are positive; the environment can be made larger."""
    spec = recording.spec
    assert len(set(spec.agents)) == spec.num_agents > 0, "agents need names of their own"
    assert len(spec.groups) in (0, spec.num_agents), "groups name each agent's group, or are empty"
    assert len(set(spec.metrics)) == len(spec.metrics), "metrics need names of their own"
    assert spec.observation_size > 0, "observations need at least one component"
    copies = min(recording.copies, 2)
    env = make(copies)
    assert env.num_copies == copies, "num_copies is the number asked for"
    assert env.spec == spec, "the spec depends on the number of copies"
    env.close()


def check_alive(make: Make, recording: Recording) -> None:
    """Who acted was alive; where agents do not come and go, all are alive always."""
    spec, track = recording.spec, recording.trajectory
    assert not (track.acting & ~track.alive[:-1]).any(), "an agent acted that was not alive"
    if not spec.agents_come_and_go:
        assert track.alive.all(), "an agent is not alive, and the spec has agents_come_and_go false"


def check_ends(make: Make, recording: Recording) -> None:
    """An episode's end ends every agent's stream, by termination or by truncation and never by both."""
    track, ended = recording.trajectory, recording.episode_ended
    assert not (track.terminated & track.truncated).any(), "terminated and truncated are both set"
    over = track.terminated | track.truncated
    assert over[ended].all(), "an episode ended, and an agent is neither terminated nor truncated"
    if not recording.spec.agents_come_and_go:
        assert (over.any(axis=-1) == ended).all(), "an agent's stream ended before the episode did"
    assert np.isfinite(recording.metrics[ended]).all(), "an episode's metrics are not finite"


def check_masks(make: Make, recording: Recording) -> None:
    """Every agent alive may do something."""
    track = recording.trajectory
    if recording.spec.has_action_mask:
        assert track.action_masks[track.alive].any(axis=-1).all(), "a live agent has no allowed action"


def check_shared_reward(make: Make, recording: Recording) -> None:
    """Where the spec says that the reward is shared, by all or in each group, every slot of these has it,
    absent agents' too."""
    rewards, spec = recording.trajectory.rewards, recording.spec
    if spec.shared_reward:
        assert (rewards == rewards[..., :1]).all(), "shared_reward is true, and rewards differ"
    if spec.shared_in_groups:
        assert spec.groups, "shared_in_groups is true, and there are no groups"
        firsts = [spec.groups.index(group) for group in spec.groups]
        assert (rewards == rewards[..., firsts]).all(), "shared_in_groups is true, and rewards differ in one"


def check_determinism(make: Make, recording: Recording) -> None:
    """The same seeds and actions give the same, in a new environment and after `reset` of a used one."""
    copies = recording.copies
    env, seeds = make(copies), seeds_from(FIRST_SEED, copies)
    others = seeds_from(FIRST_SEED + 100, copies)
    record(env, env.reset(others), RandomPlay(others), longest=7, episodes=2)
    assert_same(recording, record(env, env.reset(seeds), RandomPlay(seeds), LONGEST, episodes=2))
    env.close()


def check_copies(make: Make, recording: Recording) -> None:
    """A copy is the same whatever stands beside it, later episodes included."""
    for copy in range(recording.copies):
        alone = play(make, copies=1, first_seed=FIRST_SEED + copy)
        assert_same(alone, recording.of_copy(copy, steps=alone.steps))


def check_snapshots(make: Make, recording: Recording) -> None:
    """A snapshot kept in a checkpoint goes on bit for bit, from mid-episode and across an episode's end."""
    copies = recording.copies
    seeds = seeds_from(FIRST_SEED, copies)
    env = make(copies)
    play_on = RandomPlay(seeds)
    before = record(env, env.reset(seeds), play_on, longest=max(recording.steps // 3, 1), episodes=2)
    if not recording.spec.snapshots:
        try:
            env.snapshot()
        except HeadwayError:
            return
        finally:
            env.close()
        raise AssertionError("snapshots is false in the spec, and snapshot() raises no HeadwayError")
    snapshot, play_elsewhere = _through_a_checkpoint(env.snapshot()), pickle.loads(pickle.dumps(play_on))
    on = record(env, env.restore(env.snapshot()), play_on, LONGEST, episodes=2)
    env.close()
    other = make(copies)
    observed = other.restore(snapshot)
    np.testing.assert_array_equal(observed.alive, before.trajectory.alive[-1], "alive")
    assert_same(on, record(other, observed, play_elsewhere, LONGEST, episodes=2))
    for copy in range(copies):
        rest = min(on.steps, recording.steps - before.steps)
        assert_same(on.of_copy(copy, steps=rest), recording.of_copy(copy, before.steps, rest))
    other.close()


def _through_a_checkpoint(snapshot: Any) -> Any:  # noqa: ANN401 - opaque to the engine
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

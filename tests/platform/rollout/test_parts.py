"""Shared memory, shards, the NaN check, and the usage of a process."""

import ctypes
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rehearsal import plan_of_toy

from headway.config.experiment import BackendConfig
from headway.contracts import Discrete, EnvSpec, HeadwayError, Observations, StepResult
from headway.contracts.trajectory import arrays_in, block_nbytes
from headway.rollout import backends
from headway.rollout.nan_check import check_finite
from headway.rollout.plan import RolloutPlan
from headway.rollout.workers import usage
from headway.rollout.workers.shared_memory import Content, SharedBlock, SharedPickle
from headway.rollout.workers.usage import available_memory, proportional_memory

MEBIBYTE = 2**20


def test_a_block_is_zeros_and_of_its_size() -> None:
    block = SharedBlock.create(1000)
    array = np.frombuffer(block.buffer, np.uint8)
    assert len(array) == 1000
    assert not array.any()
    array[7] = 9
    block.close()
    block.close()
    assert array[7] == 9  # arrays outlive the descriptor


def test_arrays_of_a_loaded_pickle_lie_in_shared_memory_and_are_private_when_written() -> None:
    large, fortran = np.arange(100_000.0), np.asfortranarray(np.arange(6).reshape(2, 3))
    value = {"large": large, "again": large, "fortran": fortran, "none": np.zeros((0, 3)), "word": "bus"}
    shared = SharedPickle.of(value)
    large[0] = -1.0  # has no effect: the block is a copy
    one, other = shared.load(), shared.load()
    assert one["large"] is one["again"]
    one["large"][1] = -2.0
    assert np.array_equal(other["large"], np.arange(100_000.0))
    assert np.array_equal(one["fortran"], fortran)
    assert one["fortran"].flags.f_contiguous
    assert one["none"].shape == (0, 3)
    assert one["word"] == "bus"
    assert all(array.flags.aligned and array.flags.writeable for array in (one["large"], one["fortran"]))
    inside = np.frombuffer(shared.block.buffer, np.uint8)[shared.parts[1]]
    inside[...] = 0
    assert not other["large"].any()  # no copy was made, so this reaches it
    assert one["large"][1] == -2.0
    shared.block.close()


@pytest.mark.parametrize(
    ("content", "lower"), [("trajectories", r"rollout\.copies"), ("parameters", "the size of the networks")]
)
def test_a_block_larger_than_the_free_memory_is_refused_in_one_line(content: Content, lower: str) -> None:
    available = available_memory()
    assert available is not None
    with pytest.raises(HeadwayError, match=rf"MiB of shared memory for {content} .*lower {lower}") as refusal:
        SharedBlock.create(2 * available + 10 * MEBIBYTE, content)
    assert "\n" not in str(refusal.value)


def test_the_refusal_of_a_pickle_names_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("headway.rollout.workers.shared_memory.available_memory", lambda: MEBIBYTE)
    line = r"^no 2 MiB of shared memory for the environment \(1 MiB are free.*its size \(env\.args\)"
    with pytest.raises(HeadwayError, match=line):
        SharedPickle.of(np.zeros(2 * MEBIBYTE, np.uint8))


def test_freed_memory_between_blocks_in_use_is_returned_to_the_system() -> None:
    """A C library without malloc_trim is no error."""
    least = 40 * MEBIBYTE if hasattr(ctypes.CDLL(None), "malloc_trim") else -MEBIBYTE
    code = f"""
from headway.rollout.workers.shared_memory import give_back_memory
from headway.rollout.workers.usage import proportional_memory
blocks = [bytes(1000) for _ in range(60_000)]
del blocks[:-1]  # the last one keeps the memory before it from being returned
kept = proportional_memory()
give_back_memory()
assert kept - proportional_memory() > {least}, kept
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_memory_refused_by_the_system_is_reported_in_one_line_and_leaves_nothing_open() -> None:
    code = f"""
import resource
from pathlib import Path
from headway.contracts import HeadwayError
from headway.rollout.workers.shared_memory import SharedBlock
resource.setrlimit(resource.RLIMIT_FSIZE, ({MEBIBYTE}, {MEBIBYTE}))
before = len(list(Path("/proc/self/fd").iterdir()))
try:
    SharedBlock.create({2 * MEBIBYTE})
except HeadwayError as error:
    print(error)
assert len(list(Path("/proc/self/fd").iterdir())) == before
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("no 2 MiB of shared memory for trajectories (File too large); lower ")
    assert done.stdout.count("\n") == 1


def test_available_memory_is_limited_by_the_control_group(tmp_path: Path) -> None:
    (tmp_path / "meminfo").write_text("MemTotal: 900 kB\nMemAvailable:     500 kB\n")
    assert available_memory(tmp_path, tmp_path / "none") == 500 * 1024
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("5000\n")
    (tmp_path / "memory.stat").write_text("anon 2000\nfile 3000\ninactive_file 700\nactive_file 20\n")
    assert available_memory(tmp_path, tmp_path) == 500 * 1024
    (tmp_path / "memory.max").write_text("9000\n")
    # 4000 are not in use, and the system frees the 720 of cached files before it runs out.
    assert available_memory(tmp_path, tmp_path) == 4720
    assert available_memory(tmp_path / "none", tmp_path / "none") is None


def test_cpu_seconds_and_memory_of_this_process_are_read() -> None:
    before = time.process_time()
    while time.process_time() == before:
        pass
    assert 2 * MEBIBYTE < proportional_memory() < 10**12


def test_parameters_lie_one_after_another() -> None:
    shapes: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {
        "weight": ((2, 3, 5), np.dtype(np.float32)),
        "none": ((2, 0), np.dtype(np.float32)),
        "bias": ((2, 3), np.dtype(np.float64)),
    }
    memory = bytearray(block_nbytes(shapes))
    arrays, again = arrays_in(memory, shapes), arrays_in(memory, shapes)
    for number, (name, array) in enumerate(arrays.items(), start=1):
        assert (array.shape, array.dtype) == shapes[name]
        array[...] = number
    for number, array in enumerate(again.values(), start=1):
        assert (array == number).all()
        assert array.ctypes.data % array.itemsize == 0


@pytest.mark.parametrize(
    ("copies", "block", "workers", "counts"),
    [
        (8, 4, 2, [4, 4]),
        (8, 4, 5, [4, 4]),
        (8, 1, 3, [2, 3, 3]),
        (6, 2, 2, [2, 4]),
        (1, 1, 9, [1]),
        (12, 3, 1, [12]),
    ],
)
def test_shards_are_whole_blocks_as_equal_as_possible(
    copies: int, block: int, workers: int, counts: list[int]
) -> None:
    shards = plan_of_toy("visitors", copies=copies, block=block).shards(workers)
    assert [shard.count for shard in shards] == counts
    assert [shard.first for shard in shards] == [sum(counts[:i]) for i in range(len(counts))]


@pytest.mark.parametrize(
    ("limit", "seeds", "copies", "block", "workers"),
    [
        (1, (5,), 4, 1, 2),
        (3, (5,), 8, 4, 2),
        (2, (5, 6), 4, 2, 3),
        (5, (5, 6), 4, 4, 1),
        (1, (5, 6, 7), 2, 1, 2),
        (2, (5, 6, 7), 4, 2, 4),
        (3, (5, 6, 7, 8), 2, 2, 3),
    ],
)
def test_too_many_copies_for_a_process_are_refused_with_settings_that_work(
    limit: int, seeds: tuple[int, ...], copies: int, block: int, workers: int
) -> None:
    def plan(block: int) -> RolloutPlan:
        return _limited(plan_of_toy("visitors", seeds=seeds, copies=copies, block=block), limit)

    with pytest.raises(HeadwayError, match=rf"a process can hold {limit} cop(y|ies) of visitors") as refusal:
        plan(block).shards(workers)
    words = dict(word.split("=") for word in str(refusal.value).replace(";", "").split() if "=" in word)
    shards = plan(int(words["rollout.block"])).shards(int(words["backend.workers"]))
    assert max(shard.replicas * shard.count for shard in shards) <= limit
    held = [
        (replica, copy)
        for shard in shards
        for replica in range(shard.first_replica, shard.first_replica + shard.replicas)
        for copy in range(shard.first, shard.first + shard.count)
    ]
    assert sorted(held) == [(replica, copy) for replica in range(len(seeds)) for copy in range(copies)]


def test_an_evaluator_is_closed_if_its_collector_cannot_start(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise HeadwayError("no room")

    closed: list[object] = []
    monkeypatch.setattr(backends, "SerialCollector", full)
    monkeypatch.setattr(backends.PoolCollector, "close", lambda self: closed.append(self.pool.close()))
    plan = _limited(plan_of_toy("visitors"), 100)
    with pytest.raises(HeadwayError, match="no room"):
        backends.open_collector(BackendConfig("serial"), plan, 1, print)
    assert len(closed) == 1


def test_memory_is_read_only_every_few_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[int] = []

    def read() -> int:
        reads.append(1)
        return 7

    monkeypatch.setattr(usage, "proportional_memory", read)
    own = usage.OwnUsage()
    assert [own.read().memory_bytes for _ in range(5)] == [7] * 5
    assert len(reads) == 1


@pytest.mark.parametrize(
    ("limit", "seeds", "workers", "groups"),
    [
        (None, 3, 1, [(0, 3)]),
        (3, 3, 4, [(0, 3)]),
        (1, 3, 12, [(0, 1), (1, 1), (2, 1)]),
        (2, 3, 8, [(0, 1), (1, 2)]),
        (2, 4, 8, [(0, 2), (2, 2)]),
    ],
)
def test_replicas_form_one_group_unless_one_copy_of_each_exceeds_the_limit(
    limit: int | None, seeds: int, workers: int, groups: list[tuple[int, int]]
) -> None:
    plan = plan_of_toy("visitors", seeds=range(seeds))
    plan = plan if limit is None else _limited(plan, limit)
    shards = plan.shards(workers)
    assert sorted({(shard.first_replica, shard.replicas) for shard in shards}) == plan.groups == groups
    assert len(shards) == workers
    assert len(plan.shards(workers + len(groups) - 1)) == workers  # equally many for every group


def _limited(plan: RolloutPlan, limit: int) -> RolloutPlan:
    return replace(plan, spec=replace(plan.spec, max_copies_per_process=limit))


SPEC = EnvSpec("bridge", ("north", "south"), 2, Discrete(3), state_size=1)


def _step(copies: int = 3) -> tuple[StepResult, Observations]:
    """A valid step of (C, 2) agents, in which the second agent of copy 0 is not alive."""
    observed = Observations(
        np.zeros((copies, 2, 2), np.float32),
        np.zeros((copies, 1), np.float32),
        np.ones((copies, 2), np.bool_),
    )
    none = np.zeros((copies, 2), np.bool_)
    outcome = StepResult(
        rewards=np.zeros((copies, 2), np.float32), terminated=none.copy(), truncated=none.copy(),
        acting=~none, episode_ended=np.zeros(copies, np.bool_),
        final_observations=np.full((copies, 2, 2), np.nan, np.float32),
        final_states=np.full((copies, 1), np.nan, np.float32), metrics=np.full((copies, 0), np.nan),
    )  # fmt: skip
    observed.alive[0, 1] = False
    observed.observations[0, 1] = np.nan
    return outcome, observed


def _name(row: int) -> str:
    return f"copy {row + 10}"


def test_rows_that_learners_do_not_read_may_hold_anything() -> None:
    outcome, observed = _step()
    outcome.truncated[2, 1] = True
    outcome.final_observations[2, 1] = 0
    check_finite(SPEC, outcome, observed, 4, _name)
    check_finite(SPEC, None, observed, 0, _name)


@pytest.mark.parametrize(
    ("field", "place", "line"),
    [
        ("observations", (1, 1, 0), "observation of agent south in copy 11 at step 4"),
        ("states", (2, 0), "state in copy 12 at step 4"),
        ("rewards", (2, 0), "reward of agent north in copy 12 at step 4"),
        ("rewards", (0, 1), "reward of agent south in copy 10 at step 4"),
        ("final_observations", (2, 1, 1), "final observation of agent south in copy 12 at step 4"),
        ("final_states", (2, 0), "final state in copy 12 at step 4"),
    ],
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_not_finite_are_reported(field: str, place: tuple[int, ...], line: str, value: float) -> None:
    outcome, observed = _step()
    outcome.truncated[2] = True
    outcome.episode_ended[2] = True
    outcome.final_observations[2] = 0
    outcome.final_states[2] = 0
    check_finite(SPEC, outcome, observed, 4, _name)
    getattr(observed if hasattr(observed, field) else outcome, field)[place] = value
    with pytest.raises(HeadwayError) as failure:
        check_finite(SPEC, outcome, observed, 4, _name)
    assert f"environment bridge returned {value} as {line}; fix the environment" in str(failure.value)


def test_large_numbers_are_not_taken_for_infinity() -> None:
    """Squares of these numbers may overflow."""
    outcome, observed = _step()
    for array in (observed.observations, observed.states, outcome.rewards):
        array[...] = np.finfo(np.float32).max
    check_finite(SPEC, outcome, observed, 4, _name)

"""Projection of throughput by number of Ray workers."""

from dataclasses import replace

import pytest

from benchmarks.ray_workers import TASKS, Growth, TransferCost, _plan_of, growth_cells

FREE = TransferCost(bytes_per_step=0.0, parameter_bytes=0.0, message_s=0.0, byte_s=0.0)


@pytest.mark.parametrize("workers", [1, 2, 3, 5, 8])
def test_the_projection_distributes_blocks_as_sessions_do(workers: int) -> None:
    """The slowest worker has most blocks: with 8 blocks and 5 workers, three have two."""
    task = TASKS["bus line, 32 copies"]
    plan = _plan_of(replace(task, env="trivial", env_args={}))
    most = max(shard.count for shard in plan.shards(workers))
    growth = Growth(steps=1000, blocks=task.copies // task.block, worker_s=0.001, learn_s=0.0, transfer=FREE)
    assert growth.per_second(workers) == pytest.approx(1000 * task.copies / most)


def test_learning_is_the_limit_of_many_workers() -> None:
    growth = Growth(steps=1000, blocks=10**6, worker_s=0.001, learn_s=0.5, transfer=FREE)
    assert growth.per_second(10**6) == pytest.approx(2000, rel=1e-3)


@pytest.mark.parametrize(
    "costs",
    [
        pytest.param({"bytes_per_step": 1000.0, "byte_s": 1e-6}, id="experience"),
        pytest.param({"parameter_bytes": 1e6, "byte_s": 1e-6}, id="parameters"),
        pytest.param({"message_s": 2.0}, id="calls of four workers, eight at once"),
    ],
)
def test_transfer_times_are_added(costs: dict[str, float]) -> None:
    """Each case adds one second to the one second of four workers."""
    growth = Growth(steps=1000, blocks=4, worker_s=0.004, learn_s=0.0, transfer=replace(FREE, **costs))
    assert growth.per_second(4) == pytest.approx(500)


def test_there_is_no_projection_for_one_worker_or_more_workers_than_blocks() -> None:
    transfer = replace(FREE, parameter_bytes=1e5, byte_s=1e-6)
    growth = Growth(steps=1000, blocks=8, worker_s=0.0064, learn_s=0.0, transfer=transfer)
    cells = growth_cells(growth, one=151, two=290)
    assert cells == ["151", "290 (303)", "588", "1,111"]
    # With seven blocks, two workers have four and three, and four workers at most two.
    assert growth_cells(replace(growth, blocks=7), one=151, two=290) == ["151", "290 (266)", "519", ""]

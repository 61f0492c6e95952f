"""The sampled data do not depend on the backend, the number of workers or the other seeds of the stack."""

from dataclasses import replace

import numpy as np
import pytest
from covering import pairwise
from rehearsal import (
    TOYS,
    VISITORS,
    LoneVisitors,
    RareVisitors,
    Taken,
    assert_same,
    collector_of,
    iterations_of,
    parameters_of,
    plan_of,
    plan_of_toy,
)

from headway.contracts import HeadwayError
from headway.rollout.episodes import evaluate_rule
from headway.rollout.plan import RolloutPlan
from headway_envs.toy.visitors import OptimalVisitors


def _collected(plan: RolloutPlan, name: str, workers: int = 1, iterations: int = 3) -> list[Taken]:
    with collector_of(plan, name, workers) as collector:
        collector.begin()
        return iterations_of(collector, parameters_of(plan), 1, iterations)


@pytest.mark.parametrize(("toy", "seeds", "workers"), pairwise(TOYS, [(5,), (5, 6, 7)], [1, 3]))
def test_every_backend_samples_the_same_trajectory(toy: str, seeds: tuple[int, ...], workers: int) -> None:
    plan = plan_of_toy(toy, seeds=seeds, copies=5)  # five copies by three workers: shards of 1, 2 and 2
    serial = _collected(plan, "serial")
    assert sum(len(taken.episodes) for taken in serial) >= 5
    assert_same(serial, _collected(plan, "process", workers))


@pytest.mark.parametrize("toy", ["visitors", "tracking"])
def test_a_seed_samples_the_same_in_a_stack_as_alone(toy: str) -> None:
    stacked = _collected(plan_of_toy(toy, seeds=(5, 6, 7), block=2), "serial")
    for replica, seed in enumerate((5, 6, 7)):
        alone = _collected(plan_of_toy(toy, seeds=(seed,), block=2), "serial")
        for together, single in zip(stacked, alone, strict=True):
            rows = slice(replica * 4, replica * 4 + 4)
            for name, array in single.arrays.items():
                np.testing.assert_array_equal(together.arrays[name][:, rows], array, err_msg=name)
            ours = [replace(e, replica=0) for e in together.episodes if e.replica == replica]
            assert ours == single.episodes


def test_seeds_copies_and_iterations_have_different_draws() -> None:
    plan = plan_of_toy("trivial", seeds=(5, 6), copies=2, steps=7)  # one episode per iteration
    first, second = _collected(plan, "serial", iterations=2)
    rows = [taken.arrays["observations"][:-1, c].tobytes() for taken in (first, second) for c in range(4)]
    assert len(set(rows)) == 8
    draws = [first.arrays["actions"][:, c].tobytes() for c in range(4)]
    assert len(set(draws)) == 4


@pytest.mark.parametrize(("greedy", "episodes"), [(True, 10), (False, 1), (False, 23)])
def test_evaluation_is_the_same_on_every_backend(greedy: bool, episodes: int) -> None:
    plan = plan_of_toy("visitors", seeds=(5, 6))
    parameters = parameters_of(plan)
    with collector_of(plan, "serial") as serial, collector_of(plan, workers=2) as process:
        expected = serial.evaluate(1_000_003, episodes, greedy, parameters)
        assert [[row["episode_seed"] for row in rows] for rows in expected] == [list(range(episodes))] * 2
        assert process.evaluate(1_000_003, episodes, greedy, parameters) == expected


@pytest.mark.parametrize("seeds", [(5,), (5, 6)])
def test_a_process_never_holds_more_copies_than_the_environment_allows(seeds: tuple[int, ...]) -> None:
    plan = plan_of(RareVisitors, VISITORS, seeds, copies=2 // len(seeds))
    parameters, given = parameters_of(plan), []
    for name in ("serial", "process"):
        with collector_of(plan, name, 2) as collector:
            processes = len(collector.process_ids())
            collector.begin()
            first = collector.evaluate(7, 5, False, parameters)
            taken = iterations_of(collector, parameters, 1, 2)
            given.append((first, collector.evaluate(7, 5, True, parameters)))
            assert collector.usage().cpu_seconds > 0
        assert processes == {"serial": 1, "process": 1 + 2 // len(seeds)}[name]
        assert_same(
            taken, _collected(plan_of_toy("visitors", seeds=seeds, copies=2 // len(seeds)), "serial", 1, 2)
        )
    assert given[0] == given[1]
    ruled = evaluate_rule(RareVisitors, OptimalVisitors, VISITORS, 7, 5)
    assert [row["length"] for row in ruled] == [row["length"] for row in given[0][0][0]]


@pytest.mark.parametrize(("make", "groups", "workers"), [(LoneVisitors, 3, 6), (RareVisitors, 2, 4)])
def test_a_stack_divided_among_processes_samples_the_same_as_an_undivided_one(
    make: type[RareVisitors], groups: int, workers: int
) -> None:
    """Each process holds one copy of one seed, or of two, out of three seeds."""
    seeds = (5, 6, 7)
    plan = plan_of(make, VISITORS, seeds, copies=2)
    parameters = parameters_of(plan)
    with collector_of(plan, "process", workers) as collector:
        assert len(collector.process_ids()) == workers + min(groups, workers // groups)
        collector.begin()
        evaluated = collector.evaluate(7, 5, False, parameters)
        taken = iterations_of(collector, parameters, 1, 2)
        snapshots = collector.snapshot()
        taken += iterations_of(collector, parameters, 3, 3)
    assert_same(_collected(plan_of_toy("visitors", seeds=seeds, copies=2), "serial"), taken)
    assert {episode.replica for each in taken for episode in each.episodes} == {0, 1, 2}
    for replica, seed in enumerate(seeds):
        alone = plan_of(make, VISITORS, (seed,), copies=1)
        with collector_of(alone, "process", 1) as collector:
            assert collector.evaluate(7, 5, False, parameters_of(alone)) == [evaluated[replica]]
    with collector_of(plan, "process", workers) as collector:
        collector.restore(snapshots, 2)
        assert_same(taken[2:], iterations_of(collector, parameters, 3, 3))


def test_a_stack_beyond_the_limit_of_a_process_is_refused_by_the_serial_backend() -> None:
    plan = plan_of(LoneVisitors, VISITORS, (5, 6), copies=1)
    line = (
        "a process can hold 1 copy of visitors, and with backend=serial one would hold more; set "
        "backend=process, rollout.block=1 and backend.workers=2"
    )
    with pytest.raises(HeadwayError, match=f"^{line}$"), collector_of(plan, "serial", 1):
        pass
    with collector_of(plan, "process", 2) as collector:  # the settings that the line names
        collector.begin()
        assert collector.collect(1, parameters_of(plan))


@pytest.mark.parametrize(
    ("toy", "name"), [("visitors", "serial"), ("tracking", "serial"), ("tracking", "process")]
)
def test_restoring_a_snapshot_continues_bit_for_bit(toy: str, name: str) -> None:
    plan = plan_of_toy(toy, seeds=(5, 6))
    parameters = parameters_of(plan)
    with collector_of(plan, name) as collector:
        collector.begin()
        iterations_of(collector, parameters, 1, 1)
        snapshots = collector.snapshot()
        expected = iterations_of(collector, parameters, 2, 3)
    with collector_of(plan, name) as collector:
        collector.restore(snapshots, 1)
        assert_same(expected, iterations_of(collector, parameters, 2, 3))


@pytest.mark.parametrize(("name", "workers"), [("serial", 1), ("process", 1), ("process", 4)])
def test_snapshots_of_other_shards_are_refused_in_one_line(name: str, workers: int) -> None:
    plan = plan_of_toy("visitors")
    with collector_of(plan, workers=2) as collector:
        collector.begin()
        snapshots = collector.snapshot()
    with collector_of(plan, name, workers) as collector:
        with pytest.raises(HeadwayError, match="made with 2 workers") as refusal:
            collector.restore(snapshots, 1)
        assert "\n" not in str(refusal.value)

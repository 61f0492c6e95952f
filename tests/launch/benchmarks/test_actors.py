"""The plan of how throughput grows with Ray's workers."""

from dataclasses import replace

import pytest

from headway_launch.benchmarks.actors import Growth, Wire, growth_cells

FREE = Wire(bytes_a_step=0.0, parameter_bytes=0.0, message_s=0.0, byte_s=0.0)


def test_workers_share_out_the_steps_where_nothing_else_takes_time() -> None:
    growth = Growth(steps=1000, worker_s=0.001, learn_s=0.0, wire=FREE)
    assert growth.per_second(1, 1) == pytest.approx(1000)
    assert growth.per_second(16, 2) == pytest.approx(16_000)


def test_learning_is_the_limit_of_many_workers() -> None:
    growth = Growth(steps=1000, worker_s=0.001, learn_s=0.5, wire=FREE)
    assert growth.per_second(10**6, 1) == pytest.approx(2000, rel=1e-3)


@pytest.mark.parametrize(
    "costs",
    [
        pytest.param({"bytes_a_step": 1000.0, "byte_s": 1e-6}, id="experience"),
        pytest.param({"parameter_bytes": 5e5, "byte_s": 1e-6}, id="parameters, to two nodes"),
        pytest.param({"message_s": 2.0}, id="calls of four workers, eight at once"),
    ],
)
def test_what_goes_over_the_wire_is_added(costs: dict[str, float]) -> None:
    """A second more in each case, to four workers' second."""
    growth = Growth(steps=1000, worker_s=0.004, learn_s=0.0, wire=replace(FREE, **costs))
    assert growth.per_second(4, 2) == pytest.approx(500)


def test_nothing_is_planned_of_the_worker_from_which_the_plan_was_made_and_of_more_than_have_work() -> None:
    """Of 32 workers, on two nodes, parameters are sent twice."""
    wire = replace(FREE, parameter_bytes=1e5, byte_s=1e-6)
    growth = Growth(steps=1000, worker_s=0.0064, learn_s=0.0, wire=wire)
    cells = growth_cells(growth, copies=32, one=151, two=290)
    assert cells == ["151", "290 (303)", "588", "1,111", "2,000", "2,500"]
    assert growth_cells(growth, copies=31, one=151, two=290) == [*cells[:-1], ""]

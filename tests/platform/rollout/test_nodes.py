"""Ray workers on a cluster that loses nodes. All nodes run on this machine."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from ray_processes import assert_gone, ray_processes
from rehearsal import FaultConfig, FaultyVisitors, assert_same, iterations_of, parameters_of, plan_of

from headway.config.experiment import BackendConfig
from headway.rollout.backends import open_collector
from headway.rollout.plan import RolloutPlan
from headway.rollout.workers.ray_cluster import _without_unused_daemons

if TYPE_CHECKING:
    from ray.cluster_utils import Cluster

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.skipif(
        importlib.util.find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"'
    ),
]


@pytest.fixture
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator["Cluster"]:
    """A cluster of a head without CPUs and two nodes with two CPUs each."""
    from ray.cluster_utils import Cluster

    settings = {"object_store_memory": 10**8, "include_log_monitor": False}
    head = {"num_cpus": 0, "include_dashboard": False, "no_monitor": True}
    before = ray_processes()
    with _without_unused_daemons():
        whole = Cluster(initialize_head=True, head_node_args={**settings, **head})
    try:
        for _ in range(2):
            whole.add_node(num_cpus=2, **settings)
        yield whole
    finally:
        whole.shutdown()
    assert_gone(before)


def test_a_node_lost_in_mid_iteration_does_not_change_the_data(nodes: "Cluster", tmp_path: Path) -> None:
    """It may be lost with both workers."""

    def plan(times: int) -> RolloutPlan:
        return plan_of(FaultyVisitors, FaultConfig("kill parent", str(tmp_path), 30, copies=2, times=times))

    given, notices = {}, list[str]()
    for name, times in (("process", 0), ("ray", 1)):
        backend = BackendConfig(name, address=nodes.address)
        collector = open_collector(backend, plan(times), 2, notices.append)
        try:
            collector.begin()
            given[name] = iterations_of(collector, parameters_of(plan(0)), 1, 3)
        finally:
            collector.close()
    assert_same(given["process"], given["ray"])
    # On a busy machine a worker may also report that it waits for free CPUs.
    replaced = [notice for notice in notices if "waits for free CPUs" not in notice]
    assert 1 <= len(replaced) <= 2
    for notice in replaced:
        assert "node" in notice
        assert notice.endswith("replaced, repeating its part from the last snapshot")

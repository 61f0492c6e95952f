"""Compiled simulator of the published bus environment.

- `layout`: records
- `motion`: the action of one bus
- `rewards`: rewards and metrics; `observe`: observations
- `steps`: the functions that the environment calls
"""


def warm() -> None:
    """Load every compiled function, from the cache where possible, by one step on a tiny network."""
    import numpy as np

    from headway_envs.bus_published.config import BusPublishedConfig
    from headway_envs.bus_published.env import BusPublishedBatchedEnv
    from headway_envs.bus_published.kernel.layout import Network
    from headway_envs.bus_published.prepared import Prepared

    network = Network(
        route_first=np.array([0, 2]),
        route_stop=np.array([0, 1]),
        route_share=np.array([1.0]),
        expected_s=np.array([100.0]),
        travel_s=np.full((2, 2), 100.0),
        detour_s=np.array([[0.0, 100.0], [100.0, 0.0]]),
        occupancy=np.array([0.1, 0.2]),
        demand=np.array([1.0, 2.0]),
        centres=np.array([0, 1]),
    )
    env = BusPublishedBatchedEnv(Prepared(BusPublishedConfig(agents=1), network, "tiny"), 1)
    env.reset(np.zeros(1, np.uint64))
    env.step(np.ones((1, 1), np.int64))

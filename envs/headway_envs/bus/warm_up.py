"""Smallest possible network: one bus, one trip, two stops. Simulating it loads the compiled kernel."""

import numpy as np

from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import KNOTS, Network
from headway_envs.bus.kernel.upkeep import find_due_for_service
from headway_envs.bus.prepared import Prepared


def _integers(*values: int) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    return np.array(values, np.int64)


def tiny_network() -> Network:
    """Return a network of one trip that leaves at 05:10 and takes 100 s.

    One passenger arrives every 200 s.
    """
    return Network(
        line_slots=_integers(0, 1),
        line_patterns=_integers(0, 1),
        pattern_calls=_integers(0, 2),
        trip_pattern=_integers(0),
        trip_departure=np.array([18600.0]),
        trip_deadhead=np.zeros(1),
        trip_work_left=np.array([100.0]),
        slot_trips=_integers(0),
        slot_first=_integers(0, 1),
        slot_line=_integers(0),
        running=np.array([[100.0] * KNOTS, [0.0] * KNOTS]),
        nominal=np.array([[0.0] * KNOTS, [100.0] * KNOTS]),
        noise_sd=np.zeros(2),
        alighting=np.array([[0.0] * 4, [1.0] * 4]),
        arrival_rate=np.array([[0.005] * 4, [0.0] * 4]),
        boarding_rate=np.array([[0.005] * 4, [0.0] * 4]),
        regular_waiting=np.ones((1, 4)),
        target=np.full((1, KNOTS), 600.0),
        slowness=np.ones(2),
        detour=np.zeros(2),
        line_trip=np.array([100.0]),
        line_detour=np.zeros(1),
        queue_first=_integers(0, 200, 400),
    )


def run_tiny() -> None:
    """Simulate one service day of one hour on the tiny network, and the first interval of the next day; then
    draw another future."""
    config = BusConfig(end_hour=6)
    env = BusBatchedEnv(Prepared(config, tiny_network(), ("tiny",), "tiny"), 1)
    env.reset(np.zeros(1, np.uint64))
    for _ in range(config.ticks + 1):
        env.step(np.ones((1, 1), np.int64))
    find_due_for_service(env.network, env.settings, env.world, np.zeros((1, 1), np.bool_))
    env.branch_from(env, np.zeros(1, np.int64), np.ones(1, np.uint64))

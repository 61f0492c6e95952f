"""Allocation of the arrays of C copies."""

import numpy as np

from headway_envs.bus.kernel.layout import (
    CALL,
    DAY,
    DAY_STATE,
    LINE,
    LINE_STATE,
    OBSERVATION_SIZES,
    QUEUE,
    SLOT,
    WAIT_BINS,
    Network,
    Trace,
    World,
)


def allocate_world(net: Network, copies: int, capacity: int) -> World:
    """Return the state of `copies` copies, all zeros."""
    calls, trips = len(net.running), len(net.trip_pattern)
    lines, patterns, slots = len(net.line_slots) - 1, len(net.pattern_calls) - 1, len(net.slot_line)
    storage = int(net.queue_first[-1])
    return World(
        days=np.zeros(copies, DAY),
        slots=np.zeros((copies, slots), SLOT),
        event_time=np.zeros((copies, slots)),
        queues=np.zeros((copies, calls), QUEUE),
        calls=np.zeros((copies, calls), CALL),
        arrived_at=np.zeros((copies, storage)),
        leaves_at=np.zeros((copies, storage)),
        last_finish=np.zeros((copies, patterns)),
        lines=np.zeros((copies, lines), LINE),
        departed=np.zeros((copies, trips), np.bool_),
        trip_time=np.zeros((copies, trips)),
        congestion=np.zeros((copies, net.arrival_rate.shape[1] + 1)),
        waits=np.zeros((copies, WAIT_BINS), np.uint32),
        loads=np.zeros((copies, capacity + 1), np.uint32),
    )


def state_size(net: Network, observation: str, full: bool) -> int:
    """Return the size S of the global state: features of the day and of every line and, if `full`, all
    observations."""
    size = DAY_STATE + LINE_STATE * (len(net.line_slots) - 1)
    return size + (len(net.slot_line) * OBSERVATION_SIZES[observation] if full else 0)


def allocate_trace(net: Network, copies: int, traced: bool) -> Trace:
    """Return a trace of one day, filled with NaN; without entries if not `traced`."""
    calls = np.diff(net.pattern_calls)[net.trip_pattern] if traced else np.zeros(len(net.trip_pattern), int)
    first = np.concatenate(([0], np.cumsum(calls))).astype(np.int64)
    arrived, left, boarded, load = (np.full((copies, first[-1]), np.nan) for _ in range(4))
    return Trace(first, arrived, left, boarded, load)

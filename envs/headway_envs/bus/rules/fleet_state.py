"""State of all buses as the rules read it."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import (
    BIN_S,
    DRIVING,
    FIRST_KNOT_HOUR,
    KNOTS,
    PERIOD_ENDS_S,
    STANDING,
    TERMINAL,
)
from headway_envs.bus.kernel.upkeep import find_due_for_service

Floats = NDArray[np.float64]


def _at(curves: Floats, rows: NDArray[np.int64], time: Floats) -> Floats:
    """Return the values of rows of (rows, K) knot curves at times in s, interpolated as in the kernel."""
    place = np.clip(time / 3600.0 - FIRST_KNOT_HOUR - 0.5, 0.0, KNOTS - 1)
    knot = np.minimum(place.astype(np.int64), KNOTS - 2)
    weight = place - knot
    return np.asarray((1.0 - weight) * curves[rows, knot] + weight * curves[rows, knot + 1])


class FleetState:
    """State of all buses of C copies as (C, N) arrays; times in s. Values are computed when first read,
    because `lookahead` asks its base rule many thousand times per day."""

    def __init__(self, env: BatchedEnv) -> None:
        """Raises TypeError for any environment but the bus environment."""
        if not isinstance(env, BusBatchedEnv):
            raise TypeError(f"the bus rules need a BusBatchedEnv, not {type(env).__name__}")
        self._env, self._net, self._world = env, env.network, env.world
        self._slots = env.world.slots
        self._phase = self._slots["phase"]
        self.event: Floats = env.world.event_time
        """Time of the next event: arrival for a driving bus, else the next decision."""
        self.now: Floats = env.world.days["now"][:, None]
        """(C, 1) current time."""
        self.terminal: NDArray[np.bool_] = self._phase == TERMINAL
        """Whether the bus waits at a terminal for its next trip."""
        self.on_way: NDArray[np.bool_] = (self._phase == DRIVING) | (self._phase == STANDING)
        """Whether the bus drives or stands at a stop."""
        self.departure: Floats = env.network.trip_departure[self._slots["trip"]]
        """Scheduled departure time of the trip."""
        self.ahead: Floats = self._slots["ahead"]
        """Spacing to the bus ahead over the target headway; NaN without a neighbour."""
        self.held: Floats = self._slots["held"]
        """Holding time at the present stop so far, s."""
        self.behind: Floats = self._slots["behind"]
        """Spacing to the bus behind over the target headway; NaN without a neighbour."""

    @property
    def _call(self) -> NDArray[np.int64]:
        """Call of the next event."""
        return np.asarray(self._slots["call"] + (self._phase == DRIVING))

    @cached_property
    def headway(self) -> Floats:
        """Headway at the next event, since the last departure from that call, s; infinite before the first
        departure."""
        since = np.take_along_axis(self._world.queues["last_departure"], self._call, axis=1)
        return np.where(since > 0, self.event - since, np.inf)

    @cached_property
    def target(self) -> Floats:
        """Target headway of the pattern at the next event, s."""
        return _at(self._net.target, self._slots["pattern"], np.maximum(self.event, 0.0).clip(max=1e6))

    @cached_property
    def planned(self) -> Floats:
        """Planned time at the call of the next event."""
        return self.departure + _at(self._net.nominal, self._call, self.departure)

    @cached_property
    def due_for_service(self) -> NDArray[np.bool_]:
        """Whether the bus should go to service at its current terminal (`is_due_for_service` of the
        kernel)."""
        due = np.zeros(self._phase.shape, np.bool_)
        find_due_for_service(self._net, self._env.settings, self._world, due)
        return due

    @cached_property
    def before_schedule(self) -> NDArray[np.bool_]:
        """Whether the bus is at a terminal before its scheduled departure."""
        return np.asarray(self.terminal & (self.event < self.departure))

    @cached_property
    def follows_closely(self) -> NDArray[np.bool_]:
        """Whether the bus ahead has not yet reached the place of this bus's next event."""
        return np.asarray(self.ahead * self.target < self.event - self.now)

    @cached_property
    def boarding_rate(self) -> Floats:
        """Mean boarding passengers per s at the stop of the next event."""
        rates, start_s = self._net.boarding_rate, self._env.prepared.config.start_hour * 3600.0
        bins = (np.minimum(self.event, 1e6) - start_s) / BIN_S
        return np.asarray(rates[self._call, bins.astype(np.int64).clip(0, rates.shape[1] - 1)])

    @cached_property
    def dwell(self) -> Floats:
        """Expected dwell of a driving bus at the stop of its next event, s; 0 for other buses."""
        config = self._env.prepared.config
        boarding = self.boarding_rate * np.minimum(self.headway, 2.0 * self.target)
        share = self._net.alighting[self._call, np.digitize(self.event, PERIOD_ENDS_S)]
        alighting = share * self._slots["load"]
        # The fixed time is added if any passenger moves; their number is about Poisson.
        anyone = 1.0 - np.exp(-boarding - alighting)
        dwell = config.boarding_s * boarding + config.alighting_s * alighting + config.fixed_dwell_s * anyone
        return np.where(self._phase == DRIVING, dwell, 0.0)

    @cached_property
    def ready(self) -> Floats:
        """Expected time at which the bus is ready to leave the stop of its next event, without any holding
        there."""
        return np.asarray(self.event + self.dwell - self.held)

    @cached_property
    def forward(self) -> Floats:
        """Headway at `ready`, since the last departure from that stop, s; infinite before the first.

        Where the bus ahead has not yet reached the stop, the spacing to it.
        """
        headway = self.headway + self.dwell - self.held
        return np.where(self.on_way & self.follows_closely, self.ahead * self.target, headway)

    @cached_property
    def backward(self) -> Floats:
        """Time from `ready` until the bus behind reaches that stop, s; NaN without a bus behind."""
        there = np.where(self._phase == DRIVING, self.event, self.now)
        return np.asarray(there + self.behind * self.target - self.ready)

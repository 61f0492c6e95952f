"""Holding laws of the literature, in the form in which studies compare them.

Each computes a holding time once, when a bus is ready to leave a stop: h is the headway to the bus ahead
then, b the time until the bus behind reaches the stop, H the target headway. Holding times below 0 are 0.
With `control=minute` they are served in whole waits of `hold_s`, to the nearest. Buses leave terminals on
schedule, and go to service as under the other rules. `entry` has the tuned parameters.
"""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.rules.fleet_state import FleetState, Floats
from headway_envs.bus.rules.holding import HoldingRule


@dataclass(frozen=True)
class HoldingLaw(HoldingRule):
    """A rule given by one holding time per stop."""

    @abstractmethod
    def law(self, fleet: FleetState) -> Floats:
        """Return the holding time at the stop of the next event, s, (C, N)."""

    def hold(self, fleet: FleetState) -> NDArray[np.bool_]:
        rest = self.law(fleet) - fleet.held
        return np.asarray((fleet.on_way & (rest > 0.5 * self.prepared.config.hold_s)) | fleet.before_schedule)

    def seconds(self, fleet: FleetState) -> Floats:
        return np.where(fleet.on_way, self.law(fleet), 0.0)


@dataclass(frozen=True)
class ForwardHeadway(HoldingLaw):
    """slack + gain (H - h): Daganzo 2009, "A headway-based approach to eliminate bus bunching",
    Transportation Research Part B 43.

    The paper's gain on headways at arrival is larger by the share of a headway that boarding takes; here h is
    that when the bus is ready to leave, which contains it.
    """

    gain: float
    slack: float

    def law(self, fleet: FleetState) -> Floats:
        return self.slack + self.gain * (fleet.target - fleet.forward)


@dataclass(frozen=True)
class TwoWayHeadway(HoldingLaw):
    """slack + gain (b - h), after Daganzo and Pilachowski 2011, "Reducing bunching with bus-to-bus
    cooperation", Transportation Research Part B 45.

    The paper does not hold: buses adjust their cruising speed all the time by the spacings in front and
    behind, "much as if successive bus pairs were connected by springs" (its abstract,
    escholarship.org/uc/item/0551g0zw). Two equal springs pull by the difference of these spacings. Here a
    holding time takes the place of a lower speed, and slack that of the speed in reserve; gain and slack are
    tuned, not the paper's.
    """

    gain: float
    slack: float

    def law(self, fleet: FleetState) -> Floats:
        return self.slack + self.gain * (fleet.backward - fleet.forward)


@dataclass(frozen=True)
class SimpleControl(HoldingLaw):
    """slack - (1 - kept) e - kept beta (h - H), with e the delay against the timetable and beta the boarding
    time per second of headway: Xuan, Argote and Daganzo 2011, "Dynamic bus holding strategies for schedule
    reliability: optimal linear control and performance analysis", Transportation Research Part B 45.

    The one-parameter law of the paper holds for slack - (1 - f0) e' - beta (h' - H), with e' and h' at the
    arrival, such that the next e' is f0 e' plus noise. Boarding adds beta (h' - H) to e until the bus is
    ready. The timetable is the virtual schedule.
    """

    kept: float
    """f0: share of a delay that is left at the next stop."""
    slack: float

    def law(self, fleet: FleetState) -> Floats:
        excess = np.where(np.isfinite(fleet.forward), fleet.forward - fleet.target, 0.0)
        boarding = self.kept * self.prepared.config.boarding_s * fleet.boarding_rate * excess
        return self.slack - (1.0 - self.kept) * (fleet.ready - fleet.planned) - boarding


@dataclass(frozen=True)
class SelfCoordinating(HoldingLaw):
    """gain b: Bartholdi and Eisenstein 2012, "A self-coordinating bus route to resist bus bunching",
    Transportation Research Part B 46.

    It needs no target headway and no timetable; headways become equal by themselves: a pause in proportion to
    the time until the bus behind arrives makes a headway a weighted mean of itself and the one behind (the
    authors, nextbuzz.gatech.edu/the-idea). The paper holds at a few control points only, since buses are held
    there under regular headways too (`control_every`).
    """

    gain: float
    """Share of the backward headway for which a bus is held."""

    def law(self, fleet: FleetState) -> Floats:
        return self.gain * fleet.backward

"""Who is on the road now, and which automated vehicle has which slot."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.layout import MOST_VEHICLES, TRAFFIC, Traffic, Whole


class Roster:
    """Vehicles in the order in which they came: rows of `traffic`. Slots are taken lowest first."""

    def __init__(self, slots: int) -> None:
        self.memory: NDArray[np.void] = np.zeros(1, TRAFFIC)
        self.traffic = Traffic.of(self.memory)
        self.ids: list[str] = []
        self.row: dict[str, int] = {}
        self.entered: Whole = np.zeros(MOST_VEHICLES, np.int64)
        """Step of the episode; in V rows, as the next."""
        self.lane: Whole = np.zeros(MOST_VEHICLES, np.int64)
        self.serial: Whole = np.full(slots, -1, np.int64)
        """(N,): how many AVs had had a slot before the one that has this one, or had it last."""
        self._served = 0
        self.holder: list[str | None] = [None] * slots
        self.automated: list[tuple[int, int, str]] = []
        """(row, slot, id) of who has a slot."""
        self.automated_ids: list[str] = []

    def __len__(self) -> int:
        return len(self.ids)

    def clear(self) -> None:
        """Nobody is there."""
        self.ids, self.row = [], {}
        self.holder = [None] * len(self.holder)
        self.serial.fill(-1)
        self._served = 0
        self._list_automated()

    def free_slot(self, kept: Iterable[int] = ()) -> int:
        """The lowest slot that is free and not among the `kept`; -1: there is none."""
        kept = set(kept)
        for slot, holder in enumerate(self.holder):
            if holder is None and slot not in kept:
                return slot
        return -1

    def add(
        self, vehicle: str, link: int, slot: int, place: tuple[float, float], speed: float, step: int
    ) -> None:
        """A vehicle that entered on `link`; `place`: where it is, and the distance it has been driven."""
        row = len(self.ids)
        self.ids.append(vehicle)
        self.row[vehicle] = row
        traffic = self.traffic
        traffic.link[row], traffic.slot[row] = link, slot
        traffic.position[row], traffic.offset[row] = place[0], place[0] - place[1]
        traffic.speed[row] = traffic.before[row] = speed
        traffic.around[row] = -1
        self.entered[row], self.lane[row] = step, -1
        if slot >= 0:
            self.holder[slot], self.serial[slot] = vehicle, self._served
            self._served += 1
            self._list_automated()

    def remove(self, vehicle: str) -> None:
        """A vehicle that has gone. Those after it move up."""
        row, last = self.row.pop(vehicle), len(self.ids) - 1
        slot = int(self.traffic.slot[row])
        for array in (*self.traffic, self.entered, self.lane):
            array[row:last] = array[row + 1 : last + 1]
        del self.ids[row]
        for later in range(row, last):
            self.row[self.ids[later]] = later
        if slot >= 0:
            self.holder[slot] = None
        self._list_automated()

    def _list_automated(self) -> None:
        slots = self.traffic.slot[: len(self.ids)].tolist()
        self.automated = [
            (row, slot, vehicle)
            for row, (slot, vehicle) in enumerate(zip(slots, self.ids, strict=True))
            if slot >= 0
        ]
        self.automated_ids = [vehicle for _, _, vehicle in self.automated]

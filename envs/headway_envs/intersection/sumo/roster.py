"""Vehicles on the road, and the slots of automated vehicles."""

from collections.abc import Container

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.layout import MAX_VEHICLES, TRAFFIC, Traffic, Whole


class Roster:
    """Vehicles in order of entry, as rows of `traffic`. The lowest free slot is assigned first."""

    def __init__(self, slots: int) -> None:
        self.records: NDArray[np.void] = np.zeros(1, TRAFFIC)
        self.traffic = Traffic.of(self.records)
        self.ids: list[str] = []
        self.row: dict[str, int] = {}
        self.entered: Whole = np.zeros(MAX_VEHICLES, np.int64)
        """Step of entry, by row."""
        self.lane: Whole = np.zeros(MAX_VEHICLES, np.int64)
        """Last known lane of an AV, for counting lane changes; -1: unknown. By row."""
        self.holder: list[str | None] = [None] * slots
        self.automated: list[tuple[int, int, str]] = []
        """(row, slot, id) of each AV with a slot."""
        self.automated_ids: list[str] = []

    def __len__(self) -> int:
        return len(self.ids)

    def clear(self) -> None:
        """Remove all vehicles."""
        self.ids, self.row = [], {}
        self.holder = [None] * len(self.holder)
        self._list_automated()

    def free_slot(self, kept: Container[int]) -> int:
        """Return the lowest free slot that is not in `kept`; -1: none."""
        for slot, holder in enumerate(self.holder):
            if holder is None and slot not in kept:
                return slot
        return -1

    def add(
        self, vehicle: str, link: int, slot: int, place: tuple[float, float], speed: float, step: int
    ) -> None:
        """Add a vehicle that entered on `link`; `place`: its position and its distance driven, m."""
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
            self.holder[slot] = vehicle
            self._list_automated()

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle; later rows move up."""
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

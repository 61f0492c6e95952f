"""Metrics of an episode, computed from its counters."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.config import STEP_S, IntersectionConfig
from headway_envs.intersection.layout import SUMS
from headway_envs.intersection.sumo.bridge import Changes

GALLONS_PER_ML = 0.000264172


@dataclass
class EpisodeMetrics:
    """Counters of an episode: steps, vehicles, collisions and travel times."""

    config: IntersectionConfig
    steps: int = 0
    entered: int = 0
    arrived: int = 0
    entered_early: int = 0
    """Vehicles that entered during the warm-up."""
    arrived_early: int = 0
    """Vehicles that left during the warm-up."""
    crashes: int = 0
    avs: int = 0
    without_slot: int = 0
    pending: int = 0
    travel_s: list[float] = field(default_factory=list)
    through: list[int] = field(default_factory=lambda: [0, 0, 0, 0])
    """Number of AVs that left, by approach."""

    @property
    def outflow_vph(self) -> float:
        """Vehicles that left since the start of the episode, per hour."""
        return self.arrived * 3600 / (max(self.steps, 1) * STEP_S)

    def count(self, changes: Changes) -> None:
        """Count the changes of one step."""
        self.steps += 1
        self.pending += changes.pending
        if not (changes.entered or changes.arrived or changes.crashes):
            return
        self.entered += changes.entered
        self.arrived += changes.arrived
        if self.steps * STEP_S <= self.config.warm_up_s:
            self.entered_early += changes.entered
            self.arrived_early += changes.arrived
        self.crashes += changes.crashes
        self.avs += changes.avs
        self.without_slot += changes.without_slot
        for approach, seconds in changes.travels:
            self.through[approach] += 1
            self.travel_s.append(seconds)

    def metrics(self, account: np.void) -> list[float]:
        """Return the metrics in the order of `metrics.METRICS`.

        `account`: an ACCOUNT record with the kernel's sums.
        """
        total, steps = {name: float(account[name]) for name in SUMS}, max(self.steps, 1)
        seconds = steps * STEP_S
        late = seconds - self.config.warm_up_s
        early_in, early_out = (self.entered_early, self.arrived_early) if late > 0 else (0, 0)
        per_hour = 3600 / (late if late > 0 else seconds)
        spent = _seconds_per_passage(account["present"] * STEP_S, self.through)
        with_any, with_av, with_hdv = (max(total[f"steps_{kind}"], 1) for kind in ("all", "av", "hdv"))
        return [
            total["team_return"],
            total["paper_return"],
            self.crashes,
            self.entered * 3600 / seconds,
            self.outflow_vph,
            self.arrived / max(self.entered, 1),
            (self.entered - early_in) * per_hour,
            (self.arrived - early_out) * per_hour,
            total["vehicles"] / steps,
            self.pending / steps,
            total["speed"] / with_any,
            total["speed_av"] / with_av,
            total["speed_hdv"] / with_hdv,
            total["acceleration_av"] / with_av,
            total["acceleration_hdv"] / with_hdv,
            total["hardest_braking_av"],
            total["hardest_braking_hdv"],
            total["fuel"] / with_any * GALLONS_PER_ML,
            total["standing"] / with_any,
            self.avs,
            sum(self.through),
            self.without_slot,
            float(np.mean(self.travel_s)) if self.travel_s else seconds,
            max(spent, default=0.0),
            jain(spent),
            self.steps,
            *(account["terms"] / steps).tolist(),
        ]


def _seconds_per_passage(seconds: NDArray[np.float64], through: Sequence[int]) -> list[float]:
    """Return the time spent by AVs per AV that left, s, for each approach that AVs came from. An approach
    where all AVs are stuck counts as one AV that left."""
    return [float(spent) / max(count, 1) for spent, count in zip(seconds, through, strict=True) if spent > 0]


def jain(values: Sequence[float]) -> float:
    """Return Jain's fairness index (sum x)^2 / (n sum x^2), between 1/n and 1 (all equal); 1 without values.
    Source: Jain, Chiu and Hawe 1984."""
    array = np.asarray(values)
    squares = float((array**2).sum())
    return float(array.sum()) ** 2 / (len(array) * squares) if squares > 0 else 1.0

"""The bus environment's arguments. Every default stands here and nowhere else."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from headway.contracts.checks import require, require_at_least

SCENARIOS = ("line", "corridor", "district", "city")
"""Names of the built-in synthetic scenarios; anything else is the path of a scenario folder."""


def _share(**values: float) -> None:
    for name, value in values.items():
        require(0 <= value <= 1, f"{name} must lie between 0 and 1, not {value:g}")


def _above(low: float, **values: float) -> None:
    for name, value in values.items():
        require(value > low, f"{name} must be above {low:g}, not {value:g}")


@dataclass(frozen=True)
class RewardConfig:
    """Weights and shape of the reward r = a1 q + a2 e + a3 m + a4 c, paid once a control interval."""

    RENAMED: ClassVar[Mapping[str, str]] = {"shared": "scope: team (for true), line or own (for false)"}

    service: float = 0.4
    """a1: weight of q, passengers waiting against those a regular service would leave waiting."""
    efficiency: float = 0.1
    """a2: weight of e, crowding."""
    maintenance: float = 0.1
    """a3: weight of m, fuel and wear below their warning levels, breakdowns."""
    regularity: float = 0.4
    """a4: weight of c, even spacing."""
    scope: Literal["team", "line", "own"] = "team"
    """Whose r a bus is paid. `team`: every slot, at the depot too, the mean of all lines, so that the return
    of a day cannot be raised by staying out longer. `line`: every slot its line's, whose mean over all slots
    is the team's: it tells a bus more of what it did. `own`: each its own with its line's q, and 0 at the
    depot."""
    follower_share: float = 0.0
    """With `scope=own`: a bus is also paid, for each bus that follows it next, this share of the other's c
    less its own, since holding moves both spacings; 0: it answers for the spacing ahead of it alone."""
    foresee_upkeep: bool = False
    """True: what low fuel and wear are still to cost until the next time at the depot is charged as it
    becomes due and refunded by service: a potential (Ng, Harada and Russell 1999, undiscounted), which adds
    the same constant to every day, whatever is done. What lies hours ahead, beyond the usual discount
    factors, is so felt at once. For learning; `team_reward` never holds it."""
    preset: Literal["default", "paper"] = "default"
    """`default`: e punishes occupancy above 0.9 only; `paper`: also below 0.6, as the
    released code."""

    def __post_init__(self) -> None:
        require(self.scope in ("team", "line", "own"), f"scope must be team, line or own, not '{self.scope}'")
        require(self.preset in ("default", "paper"), f"preset must be default or paper, not '{self.preset}'")
        require_at_least(
            0,
            service=self.service,
            efficiency=self.efficiency,
            maintenance=self.maintenance,
            regularity=self.regularity,
        )
        _share(follower_share=self.follower_share)
        require(
            self.follower_share == 0 or self.scope == "own",
            f"follower_share is for scope=own; with scope={self.scope} it must be 0",
        )
        total = self.service + self.efficiency + self.maintenance + self.regularity
        require(total > 0, "at least one of the weights must be above 0")


@dataclass(frozen=True)
class NoiseConfig:
    """What differs from day to day. All factors have mean 1; sd as a share of it.

    Source of the fitted ones: SUNT, doi 10.17632/85fdtx3kr5.1, weekday 2024-08-26 and ten Sundays."""

    trip_sd: float = 0.08
    """Travel-time factor of a whole trip."""
    day_sd: float = 0.11
    """Travel-time factor of a whole day."""
    evening_peak: float = 0.25
    """Weekdays, 16 to 19 h: travel times up by a share drawn evenly from 0 to this (mean taken out)."""
    network_sd: float = 0.05
    """Slowly varying travel-time factor of the whole network (correlation time one hour)."""
    incident_probability: float = 0.003
    """Chance of an incident on one link of one trip (assumption: one trip in eight meets one)."""
    incident_factor: float = 5.0
    """Mean factor on the link time in an incident; drawn evenly from 2 to twice this less 2."""
    link_floor_sd: float = 0.10
    """Least sd of the link term left when the other factors' variance is taken from the measured one."""
    dwell_sd: float = 0.12
    """Share of the measured link-time sd that dwell explains (assumption; dwell is simulated)."""
    demand_day_sd: float = 0.03
    """Demand factor of a whole day."""
    demand_stop_hour_sd: float = 0.13
    """Gamma factor on the arrivals of each stop in each hour."""
    dispatch_s: float = 45.0
    """Mean delay between the decision to leave a terminal and leaving it, exponential, s (assumption)."""

    def __post_init__(self) -> None:
        require_at_least(
            0,
            trip_sd=self.trip_sd,
            day_sd=self.day_sd,
            evening_peak=self.evening_peak,
            network_sd=self.network_sd,
            link_floor_sd=self.link_floor_sd,
            dwell_sd=self.dwell_sd,
            demand_day_sd=self.demand_day_sd,
            demand_stop_hour_sd=self.demand_stop_hour_sd,
            dispatch_s=self.dispatch_s,
        )
        _share(incident_probability=self.incident_probability)
        require_at_least(2, incident_factor=self.incident_factor)


@dataclass(frozen=True)
class UpkeepConfig:
    """Fuel, wear and the service centre: stylised, for no data exist. Fuel, uptime and their warning as in
    BusEnv's released constants."""

    fuel_capacity: float = 100.0
    """Units in a full tank."""
    seconds_per_fuel_unit: float = 300.0
    """Driving time on one unit, s."""
    idle_share: float = 0.5
    """Fuel used standing at a stop, as a share of that used driving; layovers use none."""
    uptime_hours: float = 12.0
    """Hours in service over which the uptime falls from 1 to 0."""
    warning: float = 0.2
    """Share of fuel or uptime under which m punishes."""
    breakdowns_per_hour: float = 0.0005
    """Hazard of a breakdown of a fresh bus."""
    wear_growth: float = 3.7
    """The hazard is multiplied by exp(wear_growth x (1 - uptime))."""
    broken_s: float = 1200.0
    """A broken bus stands this long before it is towed, s."""
    service_s: float = 900.0
    """Time at the service centre, s."""
    service_below: float = 0.5
    """The centre takes buses with fuel or uptime below this share, as a depot would; 1: all. For others
    SERVICE_CENTER is masked, and is MOVE if chosen all the same. With 1, days on which policies sent buses
    there again and again, where more waiting passengers cost nothing more, were seen to break trainings."""
    detour_kmh: float = 20.0
    """Speed to the service centre and back, over 1.3 times the crow's distance."""
    detour_fixed_s: float = 120.0
    """Time added to each way, s."""
    depot_gap_s: float = 2700.0
    """A bus whose next trip is farther off than this goes to the depot, which refuels and repairs
    it."""

    def __post_init__(self) -> None:
        _above(
            0,
            fuel_capacity=self.fuel_capacity,
            seconds_per_fuel_unit=self.seconds_per_fuel_unit,
            uptime_hours=self.uptime_hours,
            service_s=self.service_s,
            detour_kmh=self.detour_kmh,
        )
        require_at_least(
            0,
            breakdowns_per_hour=self.breakdowns_per_hour,
            wear_growth=self.wear_growth,
            broken_s=self.broken_s,
            detour_fixed_s=self.detour_fixed_s,
            depot_gap_s=self.depot_gap_s,
        )
        _share(idle_share=self.idle_share, warning=self.warning, service_below=self.service_below)


@dataclass(frozen=True)
class BusConfig:
    """One bus network, its passengers, its rewards and what agents see."""

    scenario: str = "line"
    """`line` (1 line, 14 buses at once), `corridor` (10 lines, about 110), `district` (40, about 440), `city`
    (382, about 1,360), or the path of a scenario folder."""
    scenario_seed: int = 0
    """Seed of a synthetic scenario's geometry and demand."""
    day_type: Literal["weekday", "sunday"] = "weekday"
    """Which timetable, travel times and demand."""
    tick_s: float = 60.0
    """Control interval, s: agents act together once in each."""
    hold_s: float = 60.0
    """WAIT holds a bus this long, s."""
    start_hour: int = 5
    """The service day begins."""
    end_hour: int = 24
    """The service day ends; up to 26 (2 h of the next day)."""
    capacity: int = 75
    """Passengers a bus can take."""
    boarding_s: float = 3.0
    """Dwell for each boarding, s."""
    alighting_s: float = 1.1
    """Dwell for each alighting, s."""
    fixed_dwell_s: float = 6.0
    """Dwell added when anyone moves, s."""
    captive_share: float = 0.5
    """Share of the boardings, at the target headway, by passengers who wait for this line only; the others
    also take a competing service."""
    competing_headway_share: float = 0.25
    """The competing service takes the others after an exponential wait with this share of the line's target
    headway as its mean; with captive_share 0.5 boardings answer the headway with slope 0.54 (measured:
    0.47)."""
    dispatch_window_s: float = 180.0
    """A bus at a terminal decides from this long before its scheduled departure, s."""
    minimum_layover_s: float = 120.0
    """Least time between arriving at a terminal and being ready to leave, s."""
    recovery_share: float = 0.15
    """The timetable's blocks leave at least this share of a trip's time, and five minutes, for recovery."""
    observation: Literal["paper", "published", "control"] = "control"
    """`paper`: the paper's four; `published`: the released code's eight; `control`: all that a controller
    needs."""
    state: Literal["auto", "full", "aggregate"] = "aggregate"
    """`full`: line aggregates and all observations; `aggregate`: line aggregates; `auto`: full up to 50
    agents."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    upkeep: UpkeepConfig = field(default_factory=UpkeepConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)

    @property
    def arrivals_per_boarding(self) -> float:
        """Passengers with a competing service who arrive, per one of them who boards, at the target headway.

        Arrivals are uniform over a headway H, and each leaves after an exponential wait of mean x H, where x
        is `competing_headway_share`: the share x (1 - exp(-1 / x)) still waits when the bus comes."""
        x = self.competing_headway_share
        return 1.0 / (x * (1.0 - math.exp(-1.0 / x)))

    def __post_init__(self) -> None:
        require(bool(self.scenario), f"scenario must name {', '.join(SCENARIOS)} or a scenario folder")
        require_at_least(0, scenario_seed=self.scenario_seed)
        require(
            self.day_type in ("weekday", "sunday"),
            f"day_type must be weekday or sunday, not '{self.day_type}'",
        )
        require(
            self.observation in ("paper", "published", "control"),
            f"observation must be paper, published or control, not '{self.observation}'",
        )
        require(
            self.state in ("auto", "full", "aggregate"),
            f"state must be auto, full or aggregate, not '{self.state}'",
        )
        _above(0, tick_s=self.tick_s, hold_s=self.hold_s)
        require(4 <= self.start_hour < self.end_hour <= 26, "4 <= start_hour < end_hour <= 26 must hold")
        require(
            self.day_s % self.tick_s == 0,
            f"tick_s {self.tick_s:g} must divide the service day of {self.day_s:g} s",
        )
        require(self.capacity >= 1, "capacity must be at least 1")
        require_at_least(
            0,
            boarding_s=self.boarding_s,
            alighting_s=self.alighting_s,
            fixed_dwell_s=self.fixed_dwell_s,
            dispatch_window_s=self.dispatch_window_s,
            minimum_layover_s=self.minimum_layover_s,
            recovery_share=self.recovery_share,
        )
        _share(captive_share=self.captive_share)
        _above(0, competing_headway_share=self.competing_headway_share)

    @property
    def day_s(self) -> float:
        """Length of the service day, s."""
        return (self.end_hour - self.start_hour) * 3600.0

    @property
    def ticks(self) -> int:
        """Control intervals in a day: the length of an episode."""
        return int(self.day_s // self.tick_s)


__all__ = ["SCENARIOS", "BusConfig", "NoiseConfig", "RewardConfig", "UpkeepConfig"]

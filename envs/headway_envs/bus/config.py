"""Configuration of the bus environment, with all its defaults."""

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

from headway.contracts.checks import require, require_at_least, require_default, require_key, require_value

SCENARIOS = ("line", "corridor", "district", "city")
"""Names of the built-in synthetic scenarios; any other `scenario` is the path of a scenario folder."""

FIRST_HOUR, LAST_HOUR = 4, 26
"""Limits of the service day, h."""


def service_hours(first_departure_h: float, last_arrival_h: float) -> tuple[int, int]:
    """Return the `start_hour` and `end_hour` that contain a service, as far as the limits allow."""
    start = min(max(math.floor(first_departure_h), FIRST_HOUR), LAST_HOUR - 1)
    return start, max(min(math.ceil(last_arrival_h), LAST_HOUR), start + 1)


def _require_share(**values: float) -> None:
    """Raise ValueError unless every value lies between 0 and 1."""
    for name, value in values.items():
        require_key(0 <= value <= 1, name, f"must lie between 0 and 1, not {value:g}")


ObservationName = Literal["paper", "published", "control", "network"]
OBSERVATIONS: tuple[str, ...] = get_args(ObservationName)
"""Names of the observations; the kernel identifies each by its index."""


def _require_above(low: float, **values: float) -> None:
    """Raise ValueError unless every value is above `low`."""
    for name, value in values.items():
        require_key(value > low, name, f"must be above {low:g}, not {value:g}")


@dataclass(frozen=True)
class RewardConfig:
    """Weights and shape of the reward r = a1 q + a2 e + a3 m + a4 c, paid once per control interval."""

    service: float = 0.4
    """a1: weight of the service component q, which compares the number of waiting passengers with the number
    a regular service would leave waiting."""
    efficiency: float = 0.1
    """a2: weight of the efficiency component e, a penalty for crowding."""
    maintenance: float = 0.1
    """a3: weight of the maintenance component m, a penalty for breakdowns and for fuel or uptime below the
    warning level."""
    regularity: float = 0.4
    """a4: weight of the regularity component c, which rewards even spacing of buses."""
    scope: Literal["team", "line", "own"] = "team"
    """Which reward r each slot receives. `team`: every slot, also at the depot, receives the mean over all
    lines, so that staying out longer cannot raise the return of a day. `line`: every slot receives the reward
    of its line, which reflects its own actions more closely; the mean over all slots equals the team's
    reward. `own`: each bus receives its own e, m and c with its line's q, and 0 at the depot."""
    follower_share: float = 0.0
    """Only with `scope=own`: share of the follower's regularity in a bus's reward. For each bus directly
    behind it, a bus also receives this share of (the follower's c - its own c), because holding changes both
    spacings. 0: only the spacing ahead counts."""
    scale_service: bool = False
    """Only with `scope=own`. True: multiply q by the number of buses that the line has outside the depot. In
    the line's reward, c of one bus counts 1 / that number, whereas q counts fully. Without the factor buses
    learn to hold too long, especially on lines with many buses. In long trainings they do so with it, too:
    use `scope=line`."""
    foresee_upkeep: bool = False
    """True: charge the future cost of low fuel and wear, up to the next time at the depot, as soon as it
    becomes foreseeable, and refund it when the bus is serviced. This makes costs that lie hours ahead, beyond
    usual discount factors, felt at once. It is a potential (Ng, Harada and Russell 1999, undiscounted) that
    adds the same constant to every day, whatever the actions. For learning only: the metric `team_reward`
    excludes it."""
    preset: Literal["default", "paper"] = "default"
    """Shape of e. `default`: penalises occupancy above 0.9 only; `paper`: also below 0.6, as in the released
    code."""

    def __post_init__(self) -> None:
        require_value(self, "scope", self.scope in ("team", "line", "own"), "must be team, line or own")
        require_value(self, "preset", self.preset in ("default", "paper"), "must be default or paper")
        require_at_least(
            0,
            service=self.service,
            efficiency=self.efficiency,
            maintenance=self.maintenance,
            regularity=self.regularity,
        )
        _require_share(follower_share=self.follower_share)
        require_key(
            self.follower_share == 0 or self.scope == "own",
            "follower_share",
            f"is for scope=own; with scope={self.scope} it must be 0",
        )
        require_key(
            not self.scale_service or self.scope == "own",
            "scale_service",
            f"is for scope=own; with scope={self.scope} it must be false",
        )
        total = self.service + self.efficiency + self.maintenance + self.regularity
        require(total > 0, "at least one of the weights must be above 0")


@dataclass(frozen=True)
class NoiseConfig:
    """Random variation between days and trips. All factors have mean 1; sd is a share of that mean.

    Source of the fitted values: SUNT, doi 10.17632/85fdtx3kr5.1, weekday 2024-08-26 and ten Sundays.
    """

    trip_sd: float = 0.08
    """Sd of the travel-time factor of each trip."""
    day_sd: float = 0.11
    """Sd of the travel-time factor of each day."""
    evening_peak: float = 0.25
    """Evening peak on weekdays, about 16 to 19 h: the largest relative increase of travel times. Each day's
    increase is uniform between 0 and this; its mean is divided out."""
    network_sd: float = 0.05
    """Sd of the slowly varying travel-time factor of the whole network (correlation time one hour)."""
    incident_probability: float = 0.003
    """Probability of an incident per link and trip (assumption: one trip in eight meets one)."""
    incident_factor: float = 5.0
    """Mean factor f by which an incident multiplies the link's travel time, uniform from 2 to 2 f - 2."""
    link_floor_sd: float = 0.10
    """Minimum sd of the link's travel-time factor (log), when the variance of the other factors is subtracted
    from the measured one."""
    dwell_sd: float = 0.12
    """Sd of the log of link times that is due to dwell (assumption). Its variance is subtracted from the
    measured one because dwell is simulated."""
    demand_day_sd: float = 0.03
    """Sd of the demand factor of each day."""
    demand_stop_hour_sd: float = 0.13
    """Sd of the gamma-distributed factor on passenger arrivals per stop and hour."""
    dispatch_s: float = 45.0
    """Mean delay between the decision to leave a terminal and the departure, s; exponential (assumption)."""

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
        _require_share(incident_probability=self.incident_probability)
        require_at_least(2, incident_factor=self.incident_factor)


@dataclass(frozen=True)
class UpkeepConfig:
    """Fuel, wear and the service centre.

    Stylised, for lack of data; fuel, uptime and their warning level follow the constants of the released
    BusEnv.
    """

    fuel_capacity: float = 100.0
    """Capacity of the tank, fuel units."""
    seconds_per_fuel_unit: float = 300.0
    """Driving time per fuel unit, s."""
    idle_share: float = 0.5
    """Fuel consumption at a stop as a share of that while driving; layovers use none."""
    uptime_hours: float = 12.0
    """Time in service over which the uptime falls from 1 (fresh) to 0 (worn), h."""
    warning: float = 0.2
    """Warning level: fuel (as a share of the tank) or uptime below it is penalised by m."""
    breakdowns_per_hour: float = 0.0005
    """Breakdown rate of a fresh bus, per hour."""
    wear_growth: float = 3.7
    """Growth of the breakdown rate with wear: the rate is multiplied by exp(wear_growth x (1 - uptime))."""
    broken_s: float = 1200.0
    """Time from a breakdown until the bus is towed, s."""
    service_s: float = 900.0
    """Duration of a service at the service centre, s."""
    service_below: float = 0.5
    """The service centre accepts a bus only if its fuel (as a share of the tank) or uptime is below this; 1:
    any bus. For other buses SERVICE_CENTER is masked, and acts as MOVE if chosen nevertheless."""
    detour_kmh: float = 20.0
    """Speed on the way to the service centre and back, km/h, over 1.3 times the straight-line distance."""
    detour_fixed_s: float = 120.0
    """Fixed time added to each way of the detour, s."""
    depot_gap_s: float = 2700.0
    """Time until its next trip above which a bus goes to the depot, which refuels and repairs it, s."""

    def __post_init__(self) -> None:
        _require_above(
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
        _require_share(idle_share=self.idle_share, warning=self.warning, service_below=self.service_below)


@dataclass(frozen=True)
class DisruptionConfig:
    """Disruptions of every day; none by default.

    The timetable, the target headways, and the demand and running times that observations and rewards expect
    remain those of an ordinary day. A stop is named by its number in the scenario's table stops, a bus by its
    place among the agents, from 0.
    """

    surge: float = 1.0
    """Factor on the passenger arrivals at `surge_stops` during one hour."""
    surge_hour: int = 8
    """Hour of the surge."""
    surge_stops: tuple[int, ...] = ()
    """Stops of the surge; empty: all."""
    slow: float = 1.0
    """Factor on the travel times of the links that leave `slow_stops`, for departures during one hour."""
    slow_hour: int = 8
    """Hour of the slow links."""
    slow_stops: tuple[int, ...] = ()
    """Stops whose links onward are slow; empty: the middle one of each pattern."""
    breakdown_hour: int | None = None
    """Hour from whose beginning on `breakdown_bus` breaks down at its next stop between terminals; null:
    never."""
    breakdown_bus: int = 0
    """Bus that breaks down."""
    late_s: float = 0.0
    """Time after its first scheduled departure at which `late_bus` comes out of the depot, s."""
    late_bus: int = 0
    """Bus that starts late."""

    def __post_init__(self) -> None:
        _require_above(0, surge=self.surge, slow=self.slow)
        require_at_least(0, late_s=self.late_s, breakdown_bus=self.breakdown_bus, late_bus=self.late_bus)
        for off, example, is_on, keys in (
            ("surge=1", "surge=3", self.surge != 1.0, ("surge_hour", "surge_stops")),
            ("slow=1", "slow=2", self.slow != 1.0, ("slow_hour", "slow_stops")),
            ("breakdown_hour=null", "breakdown_hour=8", self.breakdown_hour is not None, ("breakdown_bus",)),
            ("late_s=0", "late_s=1200", self.late_s > 0.0, ("late_bus",)),
        ):
            for key in keys:
                fix = f"means nothing with {off}; leave it out, or switch it on, such as by {example}"
                require_default(self, key, is_on, fix)

    @property
    def hours(self) -> dict[str, int]:
        """Hours of the disruptions that are on, by key."""
        hours = {"surge_hour": self.surge_hour} if self.surge != 1.0 else {}
        if self.slow != 1.0:
            hours["slow_hour"] = self.slow_hour
        if self.breakdown_hour is not None:
            hours["breakdown_hour"] = self.breakdown_hour
        return hours


_OF_HOLDING = (
    "max_hold_s",
    "hold_levels",
    "control_every",
    "noncompliant_share",
    "skipping",
    "boarding_limit",
)
"""Keys that apply with `control=holding` only."""


@dataclass(frozen=True)
class BusConfig:
    """Bus network, passengers, rewards and observations."""

    scenario: str = "line"
    """`line` (1 line, 14 buses at once), `corridor` (10 lines, about 110 buses), `district` (40 lines, about
    440), `city` (382 lines, about 1,360), or the path of a scenario folder."""
    scenario_seed: int = 0
    """Seed of the geometry and demand of a synthetic scenario."""
    day_type: Literal["weekday", "sunday"] = "weekday"
    """Day type, which selects timetable, travel times and demand."""
    tick_s: float = 60.0
    """Control interval, s: all agents act together once per interval."""
    control: Literal["minute", "holding"] = "minute"
    """Decisions of an agent. `minute`: WAIT, MOVE or SERVICE_CENTER, again and again until its bus leaves;
    `holding`: once per stop, when its bus is ready to leave, for how long it is held. Buses then leave
    terminals at their scheduled departure plus the holding time, and go to service as under the rules."""
    hold_s: float = 60.0
    """Only with `control=minute`: holding time per WAIT, s."""
    max_hold_s: float = 180.0
    """Only with `control=holding`: the longest holding time, s."""
    hold_levels: int = 7
    """Only with `control=holding`: number of actions, evenly spaced holding times from 0 to `max_hold_s`; 0:
    actions are real numbers of seconds, Box instead of Discrete."""
    control_every: int = 1
    """Only with `control=holding`: n, if every n-th stop of a trip has control, its terminal included. At
    other stops buses leave at once."""
    noncompliant_share: float = 0.0
    """Only with `control=holding`: probability that a driver does not comply, drawn for each bus and day.
    Such a bus is never held, under learners and rules alike, and its actions are not used."""
    skipping: bool = False
    """Only with `control=holding` and its Discrete actions. True: one more action, leave at once and skip the
    next stop. No passenger boards there, and the bus stops only if passengers alight. It may skip neither the
    last stop of its trip nor one that the previous bus to leave the stop before it skips."""
    boarding_limit: float = 1.0
    """Only with `control=holding` and its Discrete actions. Below 1: one more action, leave at once and, at
    the next stop, let only this share of the waiting passengers board, rounded up. Not at the last stop of a
    trip. 1: no such action; for 0 use `skipping`."""
    start_hour: int = 5
    """Start of the service day, h."""
    end_hour: int = 24
    """End of the service day, h; up to 26 (02:00 of the next day)."""
    capacity: int = 75
    """Capacity of a bus, passengers."""
    boarding_s: float = 3.0
    """Dwell time per boarding passenger, s."""
    alighting_s: float = 1.1
    """Dwell time per alighting passenger, s."""
    fixed_dwell_s: float = 6.0
    """Fixed dwell time added if any passenger boards or alights, s."""
    captive_share: float = 0.5
    """Share of boardings, at the target headway, by captive passengers, who wait for this line only. The
    others take the competing service if it comes first."""
    competing_headway_share: float = 0.25
    """Mean wait for the competing service as a share of the line's target headway; the wait is exponential.
    With captive_share 0.5, boardings respond to the headway with slope 0.54 (measured: 0.47)."""
    dispatch_window_s: float = 180.0
    """Time before its scheduled departure from which a bus at a terminal makes decisions, s."""
    minimum_layover_s: float = 120.0
    """Minimum layover between arriving at a terminal and being ready to leave, s."""
    recovery_share: float = 0.15
    """Recovery time after each trip in the timetable's blocks, as a share of the trip's duration; at least
    five minutes."""
    observation: ObservationName = "control"
    """Features that an agent observes. `paper`: the four of the paper; `published`: the eight of the released
    code; `control`: 29, all that a controller of one line needs; `network`: 33, with those by which a policy
    that is shared by several lines can tell them apart, such as the time of a trip."""
    state: Literal["auto", "full", "aggregate"] = "aggregate"
    """Global state for central critics. `aggregate`: features of the day and of each line; `full`: also all
    agents' observations; `auto`: `full` for up to 50 agents, else `aggregate`."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    upkeep: UpkeepConfig = field(default_factory=UpkeepConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    disruptions: DisruptionConfig = field(default_factory=DisruptionConfig)

    @property
    def arrivals_per_boarding(self) -> float:
        """Number of arriving non-captive passengers for each one who boards, at the target headway.

        Arrivals are uniform over a headway H, and each passenger leaves after an exponential wait of mean x
        H, where x is `competing_headway_share`: the share x (1 - exp(-1 / x)) still waits when the bus comes.
        """
        x = self.competing_headway_share
        return 1.0 / (x * (1.0 - math.exp(-1.0 / x)))

    def __post_init__(self) -> None:
        require_value(
            self, "scenario", bool(self.scenario), f"must name {', '.join(SCENARIOS)} or a scenario folder"
        )
        require_at_least(0, scenario_seed=self.scenario_seed)
        require_value(self, "day_type", self.day_type in ("weekday", "sunday"), "must be weekday or sunday")
        require_value(
            self,
            "observation",
            self.observation in OBSERVATIONS,
            "must be paper, published, control or network",
        )
        require_value(
            self, "state", self.state in ("auto", "full", "aggregate"), "must be auto, full or aggregate"
        )
        require_value(self, "control", self.control in ("minute", "holding"), "must be minute or holding")
        _require_above(0, tick_s=self.tick_s, hold_s=self.hold_s, max_hold_s=self.max_hold_s)
        require_value(
            self, "hold_levels", self.hold_levels in (0, *range(2, 1001)), "must be 0, or 2 to 1000"
        )
        require_value(self, "control_every", self.control_every >= 1, "must be at least 1")
        for name in ("hold_s",) if self.holds else _OF_HOLDING:
            problem = f"has no effect with control={self.control}; leave it out"
            require_default(self, name, unless=False, problem=problem)
        require_value(
            self,
            "boarding_limit",
            0 < self.boarding_limit <= 1,
            "must be above 0 and at most 1 (for 0 set skipping)",
        )
        for name in ("skipping", "boarding_limit"):
            require_default(self, name, self.hold_levels > 0, "needs Discrete actions, not hold_levels=0")
        hours = f"{FIRST_HOUR} <= start_hour < end_hour <= {LAST_HOUR} must hold"
        require(
            FIRST_HOUR <= self.start_hour < self.end_hour <= LAST_HOUR,
            f"{hours}, not {self.start_hour} and {self.end_hour}; such as start_hour=5 end_hour=24",
        )
        require_value(
            self, "tick_s", self.day_s % self.tick_s == 0, f"must divide the service day of {self.day_s:g} s"
        )
        require_value(self, "capacity", self.capacity >= 1, "must be at least 1")
        require_at_least(
            0,
            boarding_s=self.boarding_s,
            alighting_s=self.alighting_s,
            fixed_dwell_s=self.fixed_dwell_s,
            dispatch_window_s=self.dispatch_window_s,
            minimum_layover_s=self.minimum_layover_s,
            recovery_share=self.recovery_share,
        )
        for name, hour in self.disruptions.hours.items():
            require_key(
                self.start_hour <= hour < self.end_hour,
                f"disruptions.{name}",
                f"must lie within the service day, {self.start_hour} to {self.end_hour - 1}, not {hour}",
            )
        _require_share(captive_share=self.captive_share, noncompliant_share=self.noncompliant_share)
        _require_above(0, competing_headway_share=self.competing_headway_share)

    @property
    def holds(self) -> bool:
        """Whether actions are holding times."""
        return self.control == "holding"

    @property
    def further_actions(self) -> tuple[str, ...]:
        """Discrete actions after the holding times, in order: `skip`, `limit`."""
        return ("skip",) * self.skipping + ("limit",) * (self.boarding_limit < 1.0)

    @property
    def hold_step_s(self) -> float:
        """Difference between two Discrete holding times, s."""
        return self.max_hold_s / (self.hold_levels - 1)

    @property
    def day_s(self) -> float:
        """Duration of the service day, s."""
        return (self.end_hour - self.start_hour) * 3600.0

    @property
    def ticks(self) -> int:
        """Number of control intervals in a day: the length of an episode."""
        return int(self.day_s // self.tick_s)

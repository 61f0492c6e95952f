"""Configuration of the published bus environment, with all its defaults."""

from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require, require_at_least, require_value
from headway_envs.bus.config import SCENARIOS


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward of a MOVE, which lies within -1 to 1.

    The reward is (-occupancy x o + uptime x u + regularity x h + efficiency x t) / sum of weights. That of
    WAIT is -0.1; that of service is -(1 + detour / 600 s), or -20 without fuel for the way.
    """

    occupancy: float = 0.5
    """Weight of o: squared distance of the occupancy from the band between `low_occupancy` and
    `high_occupancy`, scaled to 0 to 1."""
    uptime: float = 0.7
    """Weight of u: remaining uptime, 0 to 1."""
    regularity: float = 0.5
    """Weight of h: 1 - the root mean square of (interval - target) / target over all arrivals at the stop so
    far, at least 0; 0 before the second interval."""
    efficiency: float = 0.6
    """Weight of t: 1 - driving time so far today / duration of one trip to the end of the route, at least 0.
    It is therefore above 0 only during the first trip of the day, as in the released code."""
    low_occupancy: float = 0.6
    """Lower end of the band of occupancies without cost."""
    high_occupancy: float = 0.9
    """Upper end of the band of occupancies without cost."""
    target_headway_s: float = 600.0
    """Target interval between arrivals at a stop, s."""
    scope: Literal["own", "team"] = "own"
    """`own`: each bus receives its own reward, as in the released runs; `team`: every bus receives the mean,
    as in the paper."""

    def __post_init__(self) -> None:
        require_at_least(
            0,
            occupancy=self.occupancy,
            uptime=self.uptime,
            regularity=self.regularity,
            efficiency=self.efficiency,
        )
        require_value(self, "scope", self.scope in ("own", "team"), "must be own or team")
        total = self.occupancy + self.uptime + self.regularity + self.efficiency
        require(total > 0, "at least one of the weights must be above 0")
        require(
            0 < self.low_occupancy < self.high_occupancy < 1,
            "0 < low_occupancy < high_occupancy < 1 must hold",
        )
        require_value(self, "target_headway_s", self.target_headway_s > 0, "must be above 0")


@dataclass(frozen=True)
class BusPublishedConfig:
    """Buses that shuttle on fixed routes. Each has its own clock; passengers are not simulated."""

    scenario: str = "corridor"
    """Source of routes, link times, loads and boardings: `line`, `corridor`, `district`, `city`, or the path
    of a scenario folder. The tables of the published runs are not fully public."""
    scenario_seed: int = 0
    """Seed of a synthetic scenario."""
    day_type: Literal["weekday", "sunday"] = "weekday"
    """Day type, which selects link times, loads and boardings."""
    agents: int = 5
    """Number of buses. Each copy draws a route per bus from its seed, a pattern with the probability of its
    trips, and keeps it on all its days, as each worker of the released code does."""
    start_hour: int = 6
    """Hour at which every bus's clock starts."""
    end_hour: int = 24
    """Hour at which the day ends: for all buses once one clock reaches it."""
    centre: int | None = None
    """Stop of the service centre, by its position among the scenario's stops; null: drawn per copy from its
    seed, as each worker of the released code draws one."""
    max_steps: int = 2000
    """Number of steps after which a day is truncated. A day of waiting takes 1,080. Without a limit, a day
    would never end if all buses chose service without the fuel for it, because no clock would advance. The
    released runs allowed 1,000,000."""
    observation: Literal["scaled", "raw"] = "scaled"
    """`scaled`: all eight features lie between 0 and 1; `raw`: demand and the two stops are unscaled numbers,
    as in the released code."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        require_value(
            self, "scenario", bool(self.scenario), f"must name {', '.join(SCENARIOS)} or a scenario folder"
        )
        require_at_least(0, scenario_seed=self.scenario_seed)
        require_value(self, "day_type", self.day_type in ("weekday", "sunday"), "must be weekday or sunday")
        require_at_least(1, agents=self.agents)
        require(0 <= self.start_hour < self.end_hour <= 24, "0 <= start_hour < end_hour <= 24 must hold")
        require_value(self, "centre", self.centre is None or self.centre >= 0, "must be null or at least 0")
        require_at_least(1, max_steps=self.max_steps)
        require_value(self, "observation", self.observation in ("scaled", "raw"), "must be scaled or raw")

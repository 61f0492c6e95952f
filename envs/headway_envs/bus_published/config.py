"""The published bus environment's arguments. Every default stands here and nowhere else."""

from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require, require_at_least
from headway_envs.bus.config import SCENARIOS


@dataclass(frozen=True)
class RewardConfig:
    """What a MOVE is paid: (-occupancy x o + uptime x u + regularity x h + efficiency x t) / sum of weights,
    within -1 to 1. WAIT is paid -0.1, service -(1 + detour / 600 s), or -20 without fuel for the way."""

    occupancy: float = 0.5
    """Weight of o: squared distance of the occupancy from the band, 0 to 1."""
    uptime: float = 0.7
    """Weight of u: uptime left, 0 to 1."""
    regularity: float = 0.5
    """Weight of h: 1 less the root mean square of (interval - target) / target over all arrivals at the stop
    so far, not below 0; 0 before there are two intervals."""
    efficiency: float = 0.6
    """Weight of t: 1 less the time driven so far today over the time of one trip out, not below 0. So it is
    paid on the first trip of the day alone, as the released code has it."""
    low_occupancy: float = 0.6
    """The band of occupancies that cost nothing begins."""
    high_occupancy: float = 0.9
    """It ends."""
    target_headway_s: float = 600.0
    """Intervals between arrivals at a stop that are paid in full, s."""
    scope: Literal["own", "team"] = "own"
    """`own`: each bus is paid its own, as in the released runs; `team`: all the mean, as the paper says."""

    def __post_init__(self) -> None:
        require_at_least(
            0,
            occupancy=self.occupancy,
            uptime=self.uptime,
            regularity=self.regularity,
            efficiency=self.efficiency,
        )
        require(self.scope in ("own", "team"), f"scope must be own or team, not '{self.scope}'")
        total = self.occupancy + self.uptime + self.regularity + self.efficiency
        require(total > 0, "at least one of the weights must be above 0")
        require(
            0 < self.low_occupancy < self.high_occupancy < 1,
            "0 < low_occupancy < high_occupancy < 1 must hold",
        )
        require(self.target_headway_s > 0, f"target_headway_s must be above 0, not {self.target_headway_s:g}")


@dataclass(frozen=True)
class BusPublishedConfig:
    """Buses that shuttle on fixed routes, each with a clock of its own, without passengers of their own."""

    scenario: str = "corridor"
    """Whence routes, link times, loads and boardings come: `line`, `corridor`, `district`, `city`, or the
    path of a scenario folder. The tables of the published runs are not public in full."""
    scenario_seed: int = 0
    """Seed of a synthetic scenario."""
    day_type: Literal["weekday", "sunday"] = "weekday"
    """Which link times, loads and boardings."""
    agents: int = 5
    """Buses."""
    agents_per_route: int = 3
    """Buses of a route; the last route has what is left."""
    start_hour: int = 6
    """Every bus's clock begins."""
    end_hour: int = 24
    """The day ends for all when one clock passes this."""
    centre: int | None = None
    """Stop where the service centre is, by its place among the scenario's stops; null: drawn for each copy
    from its seed, as each worker of the released code draws one."""
    max_steps: int = 2000
    """Steps after which a day is cut short. Waiting throughout takes 1,080; without a limit a day in which
    all ask for service they have no fuel for would never end, as no clock goes on. The released runs allowed
    1,000,000."""
    observation: Literal["scaled", "raw"] = "scaled"
    """`scaled`: all eight within 0 to 1; `raw`: demand and the two stops as numbers, as in the released
    code."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        require(bool(self.scenario), f"scenario must name {', '.join(SCENARIOS)} or a scenario folder")
        require_at_least(0, scenario_seed=self.scenario_seed)
        require(
            self.day_type in ("weekday", "sunday"),
            f"day_type must be weekday or sunday, not '{self.day_type}'",
        )
        require_at_least(1, agents=self.agents, agents_per_route=self.agents_per_route)
        require(0 <= self.start_hour < self.end_hour <= 24, "0 <= start_hour < end_hour <= 24 must hold")
        require(
            self.centre is None or self.centre >= 0, f"centre must be null or at least 0, not {self.centre}"
        )
        require_at_least(1, max_steps=self.max_steps)
        require(
            self.observation in ("scaled", "raw"),
            f"observation must be scaled or raw, not '{self.observation}'",
        )

    @property
    def routes(self) -> int:
        """Routes in use."""
        return -(-self.agents // self.agents_per_route)


__all__ = ["BusPublishedConfig", "RewardConfig"]

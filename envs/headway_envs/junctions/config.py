"""Configuration of the junctions, with all its defaults: a crossing of two roads whose human drivers yield.
The values of the study by Yan and Wu are in `configs/env/mixed_autonomy.yaml`."""

import re
from dataclasses import dataclass

from headway.contracts import require_value
from headway.contracts.checks import require_at_least, require_key

FOUR_WAY = "four_way"
"""Name of the packaged network."""
DEFAULT_DEMAND = "700x700"
SUMO_CONFIGURATION = ".sumocfg"
MAX_VPH = 3_600
"""Maximum demand per road and direction, vehicles per hour."""


@dataclass(frozen=True)
class JunctionsConfig:
    """Junctions without signals in a SUMO network, with automated vehicles (AVs) among human-driven vehicles
    (HDVs)."""

    network: str = FOUR_WAY
    """Path of a SUMO network (.net.xml) or of a SUMO configuration (.sumocfg) that names one, or `four_way`:
    two roads that cross, with one lane per direction, 100 m long, 13 m/s, without turns. Traffic lights in
    the network are off; the rules `signal`, `signal_best` and `max_pressure` switch them on."""
    demand: str | tuple[str, ...] = DEFAULT_DEMAND
    """Path of a SUMO route file (.rou.xml), or, with network `four_way`, vehicles per hour and direction on
    the horizontal and the vertical road. These enter evenly spaced; a vehicle without room to enter is
    dropped. A list, such as `[400x850,700x700]` or `[am.rou.xml,pm.rou.xml]`: each episode draws one of
    them. The default stands for the routes of a .sumocfg, if `network` is one."""
    automated_share: float = 0.333
    """Share of vehicles that are automated, in (0, 1]: every n-th of those that enter on an edge."""
    automated_type: str = ""
    """Only vehicles of this type (a vType of the route file) can be automated; empty: vehicles of all
    types."""
    step_s: float = 0.5
    """Length of a step, s: SUMO's, and that of an action."""
    horizon: int = 2_500
    """Length of an episode in steps, without the lead-in; at its end every AV is truncated."""
    lead_in_s: float = 50.0
    """Time before the episode in which SUMO drives all vehicles, so that it starts in traffic, s."""
    warm_up_s: float = 250.0
    """Beginning of the episode left out of the metrics, s. If an episode ends earlier, they cover all of
    it."""
    slots: int = 96
    """Maximum number of controlled AVs at once. SUMO drives any others; the metric `avs_without_slot` counts
    them."""
    approaches: int | None = None
    """Number of lanes towards one junction that fit into an observation; null: the most of any junction in
    the network. Set it to evaluate a policy on another network than the one of its training."""
    av_speed_mode: int = 1
    """SUMO's checks of commanded speeds, as bits: 1 safe gap, 2 maximum acceleration, 4 maximum braking, 8
    right of way. 1: AVs keep safe gaps to vehicles ahead and ignore the right of way."""
    hdv_speed_mode: int = 31
    """SUMO's checks of human drivers' speeds, as bits; 31: all checks. With 1 they do not yield."""
    collision: float = 5.0
    """Cost of each vehicle in a collision, in vehicles that leave at the end of their route."""

    def __post_init__(self) -> None:
        require_value(self, "network", bool(self.network), "must not be empty")
        require_value(self, "demand", bool(self.demand) and all(self.demand), "must not be empty")
        vph = self.vph
        if self.network == FOUR_WAY:
            require_value(
                self,
                "demand",
                all(0 < value <= MAX_VPH for pair in vph for value in pair),
                f"must have numbers between 1 and {MAX_VPH:,}",
            )
            require_value(
                self,
                "demand",
                len(vph) in (0, len(self.demands)),
                "must be either route files or vehicles per hour, not both",
            )
        else:
            require_value(
                self, "demand", not vph, "must be a route file (.rou.xml) with a network of your own"
            )
        require_value(self, "automated_share", 0 < self.automated_share <= 1, "must lie in (0, 1]")
        require_value(self, "step_s", 0 < self.step_s <= 10, "must lie in (0, 10]")
        require_at_least(1, horizon=self.horizon, slots=self.slots)
        require_at_least(0, lead_in_s=self.lead_in_s, warm_up_s=self.warm_up_s, collision=self.collision)
        if self.approaches is not None:
            require_at_least(2, approaches=self.approaches)
        for key in ("av_speed_mode", "hdv_speed_mode"):
            mode = getattr(self, key)
            require_key(0 <= mode < 128, key, f"must lie between 0 and 127, not {mode}")

    @property
    def demands(self) -> tuple[str, ...]:
        """The demands from which episodes draw; empty: the routes of the .sumocfg."""
        if self.demand == DEFAULT_DEMAND and self.network.endswith(SUMO_CONFIGURATION):
            return ()
        return (self.demand,) if isinstance(self.demand, str) else self.demand

    @property
    def vph(self) -> tuple[tuple[int, int], ...]:
        """Vehicles per hour and direction on the horizontal and the vertical road, of each demand that is not
        a route file."""
        found = [re.fullmatch(r"(\d+)x(\d+)", demand) for demand in self.demands]
        return tuple((int(match[1]), int(match[2])) for match in found if match is not None)

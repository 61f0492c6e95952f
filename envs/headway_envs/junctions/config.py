"""Configuration of the junctions, with all its defaults: a crossing of two roads whose human drivers yield.
The values of the study by Yan and Wu are in `configs/env/mixed_autonomy.yaml`."""

import re
from dataclasses import dataclass

from headway.contracts import require_value
from headway.contracts.checks import require_at_least, require_key

FOUR_WAY = "four_way"
"""Name of the packaged network."""
MAX_VPH = 3_600
"""Maximum demand per road and direction, vehicles per hour."""


@dataclass(frozen=True)
class JunctionsConfig:
    """Junctions without signals in a SUMO network, with automated vehicles (AVs) among human-driven vehicles
    (HDVs)."""

    network: str = FOUR_WAY
    """Path of a SUMO network (.net.xml), or `four_way`: two roads that cross, with one lane per direction,
    100 m long, 13 m/s, without turns. Traffic lights in the network are off; the rules `signal` and
    `max_pressure` switch them on."""
    demand: str = "700x700"
    """Path of a SUMO route file (.rou.xml), or, with network `four_way`, vehicles per hour and direction on
    the horizontal and the vertical road. These enter evenly spaced; a vehicle without room to enter is
    dropped."""
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
        for key in ("network", "demand"):
            require_value(self, key, bool(getattr(self, key)), "must not be empty")
        if self.network == FOUR_WAY:
            vph = self.vph
            require_value(
                self,
                "demand",
                vph is None or all(0 < value <= MAX_VPH for value in vph),
                f"must have numbers between 1 and {MAX_VPH:,}",
            )
        else:
            require_value(
                self, "demand", self.vph is None, "must be a route file (.rou.xml) with a network of your own"
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
    def vph(self) -> tuple[int, int] | None:
        """Vehicles per hour and direction on the horizontal and the vertical road; None: a route file."""
        found = re.fullmatch(r"(\d+)x(\d+)", self.demand)
        return None if found is None else (int(found[1]), int(found[2]))

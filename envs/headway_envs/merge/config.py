"""Configuration of the merging environments, with all its defaults."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require_value

CAVS: Mapping[int, tuple[int, int]] = {1: (1, 3), 2: (2, 4), 3: (4, 6)}
"""Minimum and maximum number of CAVs per episode, by density."""
HDVS: Mapping[int, tuple[int, int]] = {1: (1, 3), 2: (2, 4), 3: (3, 5)}
"""Minimum and maximum number of human-driven vehicles (HDVs) per episode, by density."""
MAX_CAVS = 6


@dataclass(frozen=True)
class RewardConfig:
    """Weights of r = -collision x crashed + speed x S + ramp_end x M + spacing x min(0, H) for each CAV.

    S = (v - 10) / 20, clipped to 0 to 1; M falls to -1 towards the end of the ramp; H = ln(d / (headway_s x
    v)), with d the gap to the vehicle ahead."""

    collision: float = 200.0
    """Weight of a crash."""
    speed: float = 1.0
    """Weight of the speed."""
    ramp_end: float = 4.0
    """Weight of the penalty for being near the end of the ramp."""
    spacing: float = 4.0
    """Weight of the penalty for following too closely."""
    headway_s: float = 1.2
    """Time gap to the vehicle ahead from which there is no penalty, s."""
    scope: Literal["global", "regional", "own"] = "global"
    """Reward of a CAV. `global`: mean r of all CAVs; `regional`: mean of its own r and those of the CAVs
    directly ahead and behind, on its lane and the adjacent lane; `own`: its own r. Empty slots receive 0
    with `regional` and `own`, which counts in the return. The metric `reward` is always the mean of all
    CAVs."""

    def __post_init__(self) -> None:
        for name in ("collision", "speed", "ramp_end", "spacing"):
            require_value(self, name, getattr(self, name) >= 0, "must be at least 0")
        require_value(self, "headway_s", self.headway_s > 0, "must be above 0")
        require_value(
            self, "scope", self.scope in ("global", "regional", "own"), "must be global, regional or own"
        )


@dataclass(frozen=True)
class Dynamics:
    """Steering, lane changes, collisions and episode ends of a preset."""

    steering_from_slip: bool
    """True: convert the desired slip angle to a steering angle. False: use it as the steering angle."""
    follow_both_lanes: bool
    """True: a human driver changing lanes follows the leaders on both lanes. False: on its lane only."""
    min_change_speed: float
    """Minimum speed at which human drivers change lanes, m/s."""
    min_gain: float
    """MOBIL: minimum gain in acceleration for a lane change, m/s2."""
    max_braking: float
    """MOBIL: maximum braking that a change may impose on the new follower, m/s2."""
    tie_gain: float
    """MOBIL, with two ramp lanes: added to the gain if both lanes are equally good. Without it no vehicle
    would leave the outer ramp lane, because both ramp lanes end at the same position."""
    exact_outlines: bool
    """True: vehicles crash when their outlines intersect, and vehicles about to intersect push each other
    apart. False: they crash when one of nine points of one, shrunk to 0.9, lies in the other, and both
    continue at the lower speed."""
    ends_within_step: bool
    """True: an episode ends at the sub-step in which a CAV crashes, and the step that reaches the time limit
    has a single sub-step. False: every step has all sub-steps."""
    time_is_terminal: bool
    """True: the time limit terminates the episode. False: it truncates it."""
    masks: bool
    """True: agents receive action masks."""
    single_action_ahead: bool
    """True: the supervisor predicts an action applied once. False: one applied again in every sub-step."""


PRESETS: Mapping[str, Dynamics] = {
    "clean": Dynamics(
        steering_from_slip=True,
        follow_both_lanes=True,
        min_change_speed=1.0,
        min_gain=0.2,
        max_braking=2.0,
        tie_gain=0.21,
        exact_outlines=True,
        ends_within_step=False,
        time_is_terminal=False,
        masks=True,
        single_action_ahead=True,
    ),
    "paper": Dynamics(
        steering_from_slip=False,
        follow_both_lanes=False,
        min_change_speed=0.0,
        min_gain=0.1,
        max_braking=9.0,
        tie_gain=0.11,
        exact_outlines=False,
        ends_within_step=True,
        time_is_terminal=True,
        masks=False,
        single_action_ahead=False,
    ),
}


@dataclass(frozen=True)
class MergeConfig:
    """Traffic, rules and rewards of a merge."""

    density: int = 2
    """1: 1 to 3 CAVs and 1 to 3 human drivers; 2: 2 to 4 of each; 3: 4 to 6 CAVs, 3 to 5 human drivers."""
    cavs: int | None = None
    """Number of CAVs in every episode; null: drawn, by density."""
    max_density: int | None = None
    """Density whose largest numbers of vehicles are those of agents and of vehicles in the state, so that
    environments of different densities fit the same networks; null: `density`."""
    preset: Literal["clean", "paper"] = "clean"
    """`clean`: the dynamics of highway-env 1.12.1, tested against it, with truncation at the time limit and
    action masks; `paper`: the older dynamics and episode ends of the study, for which no reference
    implementation can be run."""
    supervisor: bool = False
    """True: actions predicted to cause a collision are replaced before they are applied."""
    steps: int = 100
    """Maximum length of an episode, in steps of 0.2 s."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        require_value(self, "density", self.density in CAVS, "must be 1, 2 or 3")
        largest = self.max_density
        require_value(
            self,
            "max_density",
            largest is None or (largest in CAVS and largest >= self.density),
            "must be null, or 1, 2 or 3 and at least density",
        )
        require_value(self, "preset", self.preset in PRESETS, "must be clean or paper")
        require_value(
            self,
            "cavs",
            self.cavs is None or 1 <= self.cavs <= MAX_CAVS,
            f"must be null or between 1 and {MAX_CAVS}",
        )
        require_value(self, "steps", self.steps >= 1, "must be at least 1")

    @property
    def cav_range(self) -> tuple[int, int]:
        """Minimum and maximum number of CAVs per episode."""
        return CAVS[self.density] if self.cavs is None else (self.cavs, self.cavs)

    @property
    def hdv_range(self) -> tuple[int, int]:
        """Minimum and maximum number of HDVs per episode."""
        return HDVS[self.density]

    @property
    def slots(self) -> tuple[int, int]:
        """Maximum numbers of CAVs and of HDVs for which there is room."""
        cavs, hdvs = self.cav_range[1], self.hdv_range[1]
        if self.max_density is None:
            return cavs, hdvs
        return max(cavs, CAVS[self.max_density][1]), HDVS[self.max_density][1]

    @property
    def dynamics(self) -> Dynamics:
        """Dynamics of the preset."""
        return PRESETS[self.preset]

"""The merging environments' arguments. Every default stands here and nowhere else."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require

CAVS: Mapping[int, tuple[int, int]] = {1: (1, 3), 2: (2, 4), 3: (4, 6)}
"""Fewest and most CAVs of an episode, by density."""
HDVS: Mapping[int, tuple[int, int]] = {1: (1, 3), 2: (2, 4), 3: (3, 5)}
"""Fewest and most vehicles driven by humans."""
MOST_CAVS = 6


@dataclass(frozen=True)
class RewardConfig:
    """r = -collision x crashed + speed x (v - 10) / 20, within 0 to 1, + ramp_end x M + spacing x min(0, H).

    M falls to -1 as the ramp ends, H = ln(d / (headway_s x v)) with d the gap to the vehicle ahead."""

    collision: float = 200.0
    """Weight of having crashed."""
    speed: float = 1.0
    """Weight of the speed."""
    ramp_end: float = 4.0
    """Weight of being near the end of the ramp."""
    spacing: float = 4.0
    """Weight of following too closely."""
    headway_s: float = 1.2
    """Time gap from which on following costs nothing, s."""
    scope: Literal["global", "regional", "own"] = "global"
    """Whose r a CAV is paid: `global`, the mean of all CAVs; `regional`, the mean of its own and those of
    the CAVs next to it, ahead and behind, on its lane and the lane beside it; `own`. Without `global`, empty
    slots are paid 0 and count in the return; the metric `reward` is the mean of all CAVs always."""

    def __post_init__(self) -> None:
        for name in ("collision", "speed", "ramp_end", "spacing"):
            require(getattr(self, name) >= 0, f"{name} must be at least 0, not {getattr(self, name):g}")
        require(self.headway_s > 0, f"headway_s must be above 0, not {self.headway_s:g}")
        require(
            self.scope in ("global", "regional", "own"),
            f"scope must be global, regional or own, not '{self.scope}'",
        )


@dataclass(frozen=True)
class Dynamics:
    """A preset: how vehicles steer, change lanes and collide, and how an episode ends."""

    steering_from_slip: bool
    """The steering angle is the one whose slip is asked for; else the slip angle is taken for it."""
    follow_both_lanes: bool
    """While changing lanes a human minds who is ahead on both; else on the lane the vehicle is in."""
    least_change_speed: float
    """A human changes lanes only at this speed or more, m/s."""
    least_gain: float
    """MOBIL: acceleration to be gained by a change, m/s2."""
    most_braking: float
    """MOBIL: braking that a change may impose on the new follower, m/s2."""
    gain_where_equal: float
    """MOBIL, with two ramp lanes: added to the gain where both lanes are equal. Both end at the same place:
    without it nobody would ever leave the outer one."""
    whole_outlines: bool
    """Vehicles crash where their outlines meet, and those about to meet push each other apart; else where one
    of nine points of one, shrunk to 0.9, lies in the other, and both go on at the lower speed."""
    ends_within_step: bool
    """An episode ends at the sub-step in which a CAV crashes, and its last step has one sub-step only."""
    time_is_terminal: bool
    """The time limit terminates; else it truncates."""
    masks: bool
    """Agents are told which actions are allowed."""
    one_action_ahead: bool
    """The supervisor foresees an action taken once; else one taken again in every sub-step."""


PRESETS: Mapping[str, Dynamics] = {
    "clean": Dynamics(
        steering_from_slip=True,
        follow_both_lanes=True,
        least_change_speed=1.0,
        least_gain=0.2,
        most_braking=2.0,
        gain_where_equal=0.21,
        whole_outlines=True,
        ends_within_step=False,
        time_is_terminal=False,
        masks=True,
        one_action_ahead=True,
    ),
    "paper": Dynamics(
        steering_from_slip=False,
        follow_both_lanes=False,
        least_change_speed=0.0,
        least_gain=0.1,
        most_braking=9.0,
        gain_where_equal=0.11,
        whole_outlines=False,
        ends_within_step=True,
        time_is_terminal=True,
        masks=False,
        one_action_ahead=False,
    ),
}


@dataclass(frozen=True)
class MergeConfig:
    """Traffic, rules and rewards of a merge."""

    density: int = 2
    """1: 1 to 3 CAVs and 1 to 3 human drivers; 2: 2 to 4 of each; 3: 4 to 6 CAVs, 3 to 5 human drivers."""
    cavs: int | None = None
    """So many CAVs in every episode; null: drawn by density."""
    preset: Literal["clean", "paper"] = "clean"
    """`clean`: the dynamics of highway-env 1.12.1, proven against it, truncation at the time limit, action
    masks; `paper`: the older dynamics and ends of the study, of which there is no oracle."""
    supervisor: bool = False
    """True: actions that are foreseen to end in a collision are replaced before they are taken."""
    steps: int = 100
    """Longest episode, in steps of 0.2 s."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        require(self.density in CAVS, f"density must be 1, 2 or 3, not {self.density}")
        require(self.preset in PRESETS, f"preset must be clean or paper, not '{self.preset}'")
        require(
            self.cavs is None or 1 <= self.cavs <= MOST_CAVS,
            f"cavs must be null or between 1 and {MOST_CAVS}, not {self.cavs}",
        )
        require(self.steps >= 1, f"steps must be at least 1, not {self.steps}")

    @property
    def cav_range(self) -> tuple[int, int]:
        """Fewest and most CAVs of an episode."""
        return CAVS[self.density] if self.cavs is None else (self.cavs, self.cavs)

    @property
    def hdv_range(self) -> tuple[int, int]:
        """Fewest and most vehicles driven by humans."""
        return HDVS[self.density]

    @property
    def manners(self) -> Dynamics:
        """The preset's."""
        return PRESETS[self.preset]


__all__ = ["CAVS", "HDVS", "MOST_CAVS", "PRESETS", "Dynamics", "MergeConfig", "RewardConfig"]

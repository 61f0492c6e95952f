"""The intersection's arguments. Every default stands here and nowhere else: it is the `clean` preset; the
paper's values stand in `configs/env/intersection_paper.yaml`."""

from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require, require_at_least

MOST_VPH = 3_600
"""On a lane, of a kind: a vehicle a second."""
STEP_S = 0.1
"""Length of a step, s."""
TERMS = ("velocity", "standstill", "progress", "delay", "lane_change", "throughput", "headway", "collision")
"""Of the reward. The paper has no term for collisions: its velocity term is 0 in such a step."""


def _one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    require(value in choices, f"{name} must be one of {', '.join(choices)}, not '{value}'")


def _mode(bits: int, **values: int) -> None:
    for name, value in values.items():
        require(0 <= value < 2**bits, f"{name} must lie between 0 and {2**bits - 1}, not {value}")


@dataclass(frozen=True)
class RewardConfig:
    """What the automated vehicles are paid, in every step. The weights are those of the kind `scaled`, in
    which each term lies in [-1, 1]; those of `paper` are fixed."""

    kind: Literal["scaled", "paper"] = "scaled"
    """`scaled`: terms of one size, outflow by the step, for the team or for each (`scope`). `paper`: the
    paper's sum, outflow in vehicles an hour since the beginning, paid to each vehicle that is there."""
    scope: Literal["team", "own"] = "team"
    """Of the kind `scaled`. `team`: all are paid the team's reward. `own`: each AV is paid for its own speed,
    standstill and headway and for its own crash, so that it can tell what it did; others' crashes, lane
    changes and who leaves are in no own reward. For learning: `team_return` is never of it."""
    velocity: float = 0.2
    """Weight of the nearness of all speeds to 20 m/s."""
    standstill: float = 0.2
    """Weight of the share of vehicles that stand."""
    progress: float = 0.1
    """Weight of the mean speed of automated vehicles over the limit."""
    delay: float = 0.1
    """Weight of the mean speed of all vehicles over the limit."""
    lane_change: float = 0.1
    """Weight of the share of automated vehicles that change lanes."""
    throughput: float = 1.0
    """Weight of a vehicle that leaves (at most one counts in a step)."""
    headway: float = 0.1
    """Weight of time headways under 1 s, the mean over automated vehicles."""
    collision: float = 25.0
    """Weight of a step with a collision. Crashed vehicles are taken away, which frees the road: too small
    a weight, and driving at full throttle pays more than right of way."""

    def __post_init__(self) -> None:
        _one_of("kind", self.kind, ("scaled", "paper"))
        _one_of("scope", self.scope, ("team", "own"))
        require(
            self.kind == "scaled" or self.scope == "team",
            "scope=own is of kind scaled; the paper pays all vehicles alike",
        )
        require_at_least(0, **dict(zip(TERMS, self.weights, strict=True)))

    @property
    def weights(self) -> tuple[float, ...]:
        """Of the scaled terms, in the order of `TERMS`."""
        return tuple(float(getattr(self, term)) for term in TERMS)


@dataclass(frozen=True)
class IntersectionConfig:
    """One crossing of two roads of two lanes a direction, its demand, and what automated vehicles (AVs) see
    and are paid among human-driven ones (HDVs)."""

    junction: Literal["priority", "right_before_left", "allway_stop"] = "priority"
    """Right of way: of the road from north to south, of who comes from the right, or of who stopped first."""
    vph_per_lane_hdv: float = 200.0
    """Human-driven vehicles an hour on each of the eight entry lanes (Poisson)."""
    vph_per_lane_av: float = 200.0
    """Automated vehicles an hour on each of the eight entry lanes (Poisson)."""
    horizon: int = 1500
    """Steps of an episode, 0.1 s each; at its end every AV is truncated."""
    action_repeat: int = 1
    """For how many steps of 0.1 s each action lasts. Rewards are summed over them, and what is counted in
    environment steps (`env_steps`, `rollout.steps`, the discount, an episode's length) is counted in actions,
    each of which takes so many steps to simulate; `horizon` and the metrics still in 0.1 s. Who enters
    meanwhile keeps its speed until it is asked."""
    slots: int = 96
    """AVs at once. Those beyond are driven by SUMO and counted by the metric `avs_without_slot`."""
    observation: Literal["paper", "extended"] = "extended"
    """`paper`: own place and speed, leader and follower. `extended`: also the own turn, the same
    distances at a scale on which braking shows, and who comes next on the ways that cross the own."""
    av_speed_mode: int = 7
    """SUMO's checks of commanded speeds, as bits: 1 safe gap, 2 greatest acceleration, 4 greatest braking, 8
    right of way. 1: the paper's, with which vehicles brake harder than they can. 11: a guard, under which
    AVs hardly ever crash, since it brakes them as hard as that takes (`hardest_braking_av`)."""
    hdv_speed_mode: int = 31
    """The same of human drivers; 31: all checks. At 1, the paper's, they crash among themselves."""
    av_lane_change_mode: int = 512
    """SUMO's lane-change mode of AVs; 512: none of their own, each lane leads where they want to go."""
    impatience: float = 0.0
    """SUMO's, of all drivers. 0: they wait for a gap; above, they make those with right of way brake, as
    Flow's vehicles and so the paper's do at 0.5, and humans may crash."""
    human_noise: float = 0.0
    """Standard deviation of the noise of human drivers' acceleration, m/s^2 in a step of 1 s; above 0 they
    are driven by our Intelligent Driver Model, which is slower (the paper's have noise; 0.2 is usual)."""
    on_collision: Literal["remove_pair", "end_episode"] = "remove_pair"
    """The crashed vehicles are taken away and the episode goes on, or it ends."""
    at_exit: Literal["truncated", "terminated"] = "truncated"
    """How the stream of an AV that leaves ends. `truncated`: as if it went on, so leaving costs nothing: it
    is worth what the team still earns, or with own rewards what it would earn if the road went on;
    `terminated`: its return is over, which with rewards above 0 punishes leaving."""
    warm_up_s: float = 30.0
    """Rates `..._warm_vph` count from here, since nobody can have crossed in the first 12 s; those of an
    episode that ends before count all of it."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        _one_of("junction", self.junction, ("priority", "right_before_left", "allway_stop"))
        _one_of("observation", self.observation, ("paper", "extended"))
        _one_of("on_collision", self.on_collision, ("remove_pair", "end_episode"))
        _one_of("at_exit", self.at_exit, ("truncated", "terminated"))
        require_at_least(0, vph_per_lane_hdv=self.vph_per_lane_hdv, human_noise=self.human_noise)
        require(0 <= self.impatience <= 1, f"impatience must lie between 0 and 1, not {self.impatience:g}")
        require(self.vph_per_lane_av > 0, f"vph_per_lane_av must be above 0, not {self.vph_per_lane_av:g}")
        for name in ("vph_per_lane_hdv", "vph_per_lane_av"):
            vph = getattr(self, name)
            # SUMO makes all that are asked for, and those for whom there is no room wait in its memory.
            require(vph <= MOST_VPH, f"{name} must be at most {MOST_VPH:,}, a vehicle a second, not {vph:g}")
        require_at_least(1, horizon=self.horizon, action_repeat=self.action_repeat, slots=self.slots)
        require(
            self.action_repeat <= self.horizon,
            f"action_repeat must be at most horizon, {self.horizon}, not {self.action_repeat}",
        )
        _mode(7, av_speed_mode=self.av_speed_mode, hdv_speed_mode=self.hdv_speed_mode)
        _mode(12, av_lane_change_mode=self.av_lane_change_mode)
        require_at_least(0, warm_up_s=self.warm_up_s)

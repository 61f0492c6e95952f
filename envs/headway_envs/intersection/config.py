"""Configuration of the intersection, with all its defaults: the `clean` preset. The paper's values are in
`configs/env/intersection_paper.yaml`."""

from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require, require_at_least, require_key, require_value

MAX_VPH = 3_600
"""Maximum demand per lane and vehicle kind, vehicles per hour: one vehicle per second."""
STEP_S = 0.1
"""Length of a step, s."""
GREEN_S, CLEAR_S = 30.0, 4.0
"""Green of each road in the rule `virtual_signal`, and clearance time between two greens, s."""
TERMS = ("velocity", "standstill", "progress", "delay", "lane_change", "throughput", "headway", "collision")
"""Terms of the reward. The paper has no term for collisions; its velocity term is 0 in a step with one."""


def _one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    require_key(value in choices, name, f"must be one of {', '.join(choices)}, not '{value}'")


def _mode(bits: int, **values: int) -> None:
    for name, value in values.items():
        require_key(0 <= value < 2**bits, name, f"must lie between 0 and {2**bits - 1}, not {value}")


@dataclass(frozen=True)
class RewardConfig:
    """Reward of the automated vehicles per step. The weights apply to kind `scaled`, whose terms lie in
    [-1, 1]; the weights of kind `paper` are fixed."""

    kind: Literal["scaled", "paper"] = "scaled"
    """`scaled`: terms of equal size, outflow per step, for the team or each vehicle (`scope`). `paper`: the
    paper's sum, with the outflow in vehicles per hour since the start of the episode, for each vehicle
    present."""
    scope: Literal["team", "own"] = "team"
    """Only with kind `scaled`. `team`: every AV receives the team's reward. `own`: each AV receives a reward
    for its own speed, standstill, headway and crash, which reflects its own actions more closely; lane
    changes, departures and crashes of others are left out. For learning only: the metric `team_return`
    excludes it."""
    velocity: float = 0.2
    """Weight of the closeness of all speeds to 20 m/s."""
    standstill: float = 0.2
    """Weight of the penalty for the share of standing vehicles."""
    progress: float = 0.1
    """Weight of the mean speed of automated vehicles, relative to the speed limit."""
    delay: float = 0.1
    """Weight of the mean speed of all vehicles, relative to the speed limit."""
    lane_change: float = 0.1
    """Weight of the penalty for the share of automated vehicles that change lanes."""
    throughput: float = 1.0
    """Weight of a departing vehicle (at most one counts per step)."""
    headway: float = 0.1
    """Weight of the penalty for time headways below 1 s, mean over automated vehicles."""
    collision: float = 25.0
    """Weight of the penalty for a step with a collision. Crashed vehicles are removed, which frees the road:
    with too small a weight, driving at full throttle earns more than keeping the right of way."""

    def __post_init__(self) -> None:
        _one_of("kind", self.kind, ("scaled", "paper"))
        _one_of("scope", self.scope, ("team", "own"))
        require(
            self.kind == "scaled" or self.scope == "team",
            "scope=own is for kind=scaled; with kind=paper all vehicles receive the same reward",
        )
        require_at_least(0, **dict(zip(TERMS, self.weights, strict=True)))

    @property
    def weights(self) -> tuple[float, ...]:
        """Weights of the scaled terms, in the order of `TERMS`."""
        return tuple(float(getattr(self, term)) for term in TERMS)


@dataclass(frozen=True)
class IntersectionConfig:
    """Junction of two roads with two lanes per direction: its demand, and the observations and rewards of
    automated vehicles (AVs) among human-driven vehicles (HDVs)."""

    junction: Literal["priority", "right_before_left", "allway_stop"] = "priority"
    """Vehicles with the right of way: those of the north-south road (`priority`), vehicles from the right
    (`right_before_left`), or the vehicle that stopped first (`allway_stop`)."""
    vph_per_lane_hdv: float = 200.0
    """Human-driven vehicles per hour on each of the eight entry lanes (Poisson)."""
    vph_per_lane_av: float = 200.0
    """Automated vehicles per hour on each of the eight entry lanes (Poisson)."""
    horizon: int = 1500
    """Length of an episode in steps of 0.1 s; at its end every AV is truncated."""
    action_repeat: int = 1
    """Number of steps of 0.1 s per action. Rewards are summed over them. Environment steps (`env_steps`,
    `rollout.steps`, the discount, the length of an episode) then count actions; `horizon` and the metrics
    still count steps of 0.1 s. An AV that enters between two actions keeps its speed until the next one."""
    slots: int = 96
    """Maximum number of controlled AVs at once. SUMO drives any others; the metric `avs_without_slot` counts
    them."""
    observation: Literal["paper", "extended", "platoons"] = "extended"
    """`paper`: own position and speed, leader and follower. `extended`: also the vehicle's turn, distances on
    a scale suited to braking, and the next vehicles on conflicting paths. `platoons`: that of the environment
    `junctions`, the platoons on all other entry lanes."""
    clock: bool = False
    """AVs also observe a clock that they share: sine and cosine of the time since the green of their own road
    began, in the 68 s cycle of the rule `virtual_signal`."""
    av_speed_mode: int = 7
    """SUMO's checks of commanded speeds, as bits: 1 safe gap, 2 maximum acceleration, 4 maximum braking, 8
    right of way. 1: the paper's value, which allows braking beyond the vehicles' maximum. 11: a safeguard;
    AVs then hardly ever crash, because SUMO brakes them as hard as needed (`hardest_braking_av`)."""
    hdv_speed_mode: int = 31
    """SUMO's checks of human drivers' speeds, as bits; 31: all checks. With 1, the paper's value, they crash
    into each other."""
    av_lane_change_mode: int = 512
    """SUMO's lane-change mode of AVs; 512: SUMO itself changes no lanes. No changes are needed, because AVs
    enter on a lane that leads to their exit."""
    impatience: float = 0.0
    """SUMO's impatience of all drivers. 0: they wait for a gap. Above 0 they make vehicles with the right of
    way brake, and humans may crash; Flow's vehicles, and thus the paper's, have 0.5."""
    human_noise: float = 0.0
    """Standard deviation of the noise on human drivers' acceleration, m/s^2 in a step of 1 s. Above 0 they
    are driven by Headway's Intelligent Driver Model, which is slower (the paper has noise; 0.2 is usual)."""
    on_collision: Literal["remove_pair", "end_episode"] = "remove_pair"
    """`remove_pair`: crashed vehicles are removed and the episode continues. `end_episode`: it ends."""
    at_exit: Literal["truncated", "terminated"] = "truncated"
    """How the stream of an AV ends when it leaves. `truncated`: a value estimate continues its return (the
    team's further reward or, with scope `own`, its own reward on a longer road), so that leaving costs
    nothing. `terminated`: its return is complete, which punishes leaving if rewards are above 0."""
    warm_up_s: float = 30.0
    """Warm-up, s, left out of the rates `..._warm_vph`, because no vehicle can cross in the first 12 s. If an
    episode ends earlier, they cover all of it."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        _one_of("junction", self.junction, ("priority", "right_before_left", "allway_stop"))
        _one_of("observation", self.observation, ("paper", "extended", "platoons"))
        _one_of("on_collision", self.on_collision, ("remove_pair", "end_episode"))
        _one_of("at_exit", self.at_exit, ("truncated", "terminated"))
        require_at_least(0, vph_per_lane_hdv=self.vph_per_lane_hdv, human_noise=self.human_noise)
        require_value(self, "impatience", 0 <= self.impatience <= 1, "must lie between 0 and 1")
        require_value(self, "vph_per_lane_av", self.vph_per_lane_av > 0, "must be above 0")
        for name in ("vph_per_lane_hdv", "vph_per_lane_av"):
            vph = getattr(self, name)
            # SUMO creates all requested vehicles and queues those without room, without a limit.
            require_value(self, name, vph <= MAX_VPH, f"must be at most {MAX_VPH:,}, one vehicle per second")
        require_at_least(1, horizon=self.horizon, action_repeat=self.action_repeat, slots=self.slots)
        require_value(
            self,
            "action_repeat",
            self.action_repeat <= self.horizon,
            f"must be at most horizon, {self.horizon}",
        )
        _mode(7, av_speed_mode=self.av_speed_mode, hdv_speed_mode=self.hdv_speed_mode)
        _mode(12, av_lane_change_mode=self.av_lane_change_mode)
        require_at_least(0, warm_up_s=self.warm_up_s)

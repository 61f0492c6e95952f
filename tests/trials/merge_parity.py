"""Headway's merges compared with highway-env's, step by step: `python -m tests.trials.merge_parity [SEEDS]`.

Both start from the same state with the same actions and run freely until the first contact, or until a
vehicle almost stands: there the steering gain, 1 / speed, amplifies rounding errors tenfold per step, so that
two programs with different rounding must diverge. From then on Headway's state is set to highway-env's after
every simulation step, and each step is compared separately. Positions, headings and speeds must agree to 1e-9
throughout; lanes, target lanes, allowed actions and crashes exactly. Displacements by imminent contacts must
agree to 1e-3, because rounding decides between faces of equal depth.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts.errors import HeadwayError
from headway_envs.merge.config import MergeConfig
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.layout import ACTIONS, AS_HUMAN, IDLE, LEFT, STEP_S, SUBSTEPS
from headway_envs.merge.kernel.motion import simulate
from headway_envs.merge.kernel.observe import observe
from headway_envs.merge.kernel.steps import apply_actions
from headway_envs.merge.prepared import prepare

if TYPE_CHECKING:
    from tests.trials.merge_oracle import Oracle

TOLERANCE, PUSH_TOLERANCE = 1e-9, 1e-3
SLOW = 1.0
"""Speed below which the free comparison ends, m/s."""
MOTION = ("x", "y", "heading", "speed")
PLAYS = ("idle", "left", "random", "human")
"""Behaviours of the CAVs; `human`: they drive as human drivers."""
EAGER = {"min_gain": 0.1, "max_braking": 9.0, "tie_gain": 0.11}
"""The study's constants of MOBIL, with more lane changes than highway-env's."""


@dataclass(frozen=True)
class Trial:
    """An episode to run in both simulators."""

    ramp_lanes: int
    density: int
    play: str
    seed: int
    eager: bool = False
    """True: human drivers have the constants `EAGER`."""
    steps: int = 100


@dataclass(frozen=True)
class Verdict:
    """Differences between the simulators in one episode."""

    free: float
    """Largest difference while both ran freely."""
    stepwise: float
    """Largest difference within one step, after that."""
    push: float
    """Largest difference of a displacement."""
    contact: bool
    """True: there was a contact between vehicles or with an obstacle."""
    lane_changes: int
    """Number of changes of target lane within a road."""
    faults: tuple[str, ...]
    """One line per violated requirement."""


class _Pair:
    """One episode in both simulators."""

    def __init__(self, trial: Trial) -> None:
        prepared = prepare(MergeConfig(density=trial.density, preset="clean"), trial.ramp_lanes)
        self.env = env = MergeBatchedEnv(prepared, 1)
        env.reset(np.array([trial.seed], np.uint64))
        for name, value in EAGER.items() if trial.eager else ():
            env.settings[name] = value
        self.k, episode = env.settings[0], env.world.episodes[0]
        self.cavs, self.moving = int(episode["cavs"]), int(episode["cars"])
        self.cars = env.world.cars[0]
        constants = {
            "LANE_CHANGE_MIN_ACC_GAIN": float(self.k["min_gain"]),
            "LANE_CHANGE_MAX_BRAKING_IMPOSED": float(self.k["max_braking"]),
            "GAIN_WHERE_EQUAL": float(self.k["tie_gain"]) if trial.ramp_lanes == 2 else -np.inf,
        }
        beginning, all_human = self.cars[: self.moving].copy(), trial.play == "human"
        self.oracle = _oracle()(beginning, self.cavs, trial.ramp_lanes, constants, all_human)

    def act(self, actions: NDArray[np.int64]) -> None:
        apply_actions(self.env.network, self.k, self.cars, self.cavs, actions)
        self.oracle.act(actions)

    def step(self) -> None:
        bodies = self.moving + len(self.env.network.obstacles)
        simulate(self.env.network, self.k, self.cars, self.moving, bodies, STEP_S)
        self.oracle.step(STEP_S)

    @property
    def motion(self) -> NDArray[np.float64]:
        """(vehicles, 6), as `Oracle.motion`."""
        cars = self.cars[: self.moving]
        push = [np.where(cars["pushed"], cars[name], 0.0) for name in ("push_x", "push_y")]
        return np.stack([*(cars[name] for name in MOTION), *push], axis=1)

    @property
    def lanes(self) -> NDArray[np.int64]:
        """(vehicles, 2): lane and target lane."""
        return np.stack([self.cars[name][: self.moving] for name in ("lane", "target_lane")], axis=1)

    @property
    def crashed(self) -> NDArray[np.bool_]:
        """(vehicles,)"""
        return np.asarray(self.cars["crashed"][: self.moving] != 0)

    @property
    def lane_changes(self) -> NDArray[np.int64]:
        """(vehicles, 2): the road of the target lane, by its first lane, and the target lane."""
        targets = self.oracle.lanes[:, 1]
        return np.stack([self.env.network.lanes["first"][targets], targets], axis=1)

    def synchronise(self) -> None:
        """Set Headway's state to highway-env's."""
        cars, motion = self.cars[: self.moving], self.oracle.motion
        for column, name in enumerate((*MOTION, "push_x", "push_y")):
            cars[name] = motion[:, column]
        cars["cosine"], cars["sine"] = np.cos(cars["heading"]), np.sin(cars["heading"])

    def allowed(self) -> tuple[list[Any], list[Any]]:
        """Return the allowed actions of each CAV, by Headway and by highway-env."""
        observe(self.env.network, self.k, self.env.world, self.env.outputs, 0)
        masks = self.env.outputs.masks[0, : self.cavs]
        return [set(np.flatnonzero(mask)) for mask in masks], [*map(self.oracle.allowed, range(self.cavs))]


def compare(trial: Trial) -> Verdict:
    """Run one episode in both simulators. Raises HeadwayError if highway-env is not installed."""
    pair, draw = _Pair(trial), np.random.default_rng(trial.seed)
    free, stepwise, push, together, contact, changes = 0.0, 0.0, 0.0, False, False, 0
    faults: list[str] = []

    def require_equal(step: int, what: str, mine: Any, theirs: Any) -> None:  # noqa: ANN401 - arrays or lists
        if not np.array_equal(mine, theirs):
            faults.append(f"simulation step {step}: {what} {mine} against {theirs}")

    for step in range(SUBSTEPS * trial.steps):
        if step % SUBSTEPS == 0:
            pair.act(_actions(trial.play, pair.cavs, draw))
            if trial.play != "human":
                require_equal(step, "actions allowed", *pair.allowed())
        before = pair.lane_changes
        pair.step()
        after = pair.lane_changes
        changes += int(((before[:, 0] == after[:, 0]) & (before[:, 1] != after[:, 1])).sum())
        require_equal(step, "crashed", pair.crashed, pair.oracle.crashed)
        require_equal(step, "lanes", pair.lanes, pair.oracle.lanes)
        difference = np.abs(pair.motion - pair.oracle.motion)
        apart, push = float(difference[:, :4].max()), max(push, float(difference[:, 4:].max()))
        if together:
            stepwise = max(stepwise, apart)
        else:
            free = max(free, apart)
        contact = contact or bool(pair.crashed.any() or pair.cars["pushed"][: pair.moving].any())
        together = together or contact or bool((pair.oracle.motion[:, 3] < SLOW).any())
        if together:
            pair.synchronise()
    if max(free, stepwise) > TOLERANCE:
        faults.append(f"{max(free, stepwise):.1e} apart")
    if push > PUSH_TOLERANCE:
        faults.append(f"displacements {push:.1e} apart")
    return Verdict(free, stepwise, push, contact, changes, tuple(faults))


def _oracle() -> "type[Oracle]":
    try:
        from tests.trials.merge_oracle import Oracle
    except ModuleNotFoundError as error:
        raise HeadwayError("the oracle highway-env is missing: pip install 'headway[dev]'") from error
    return Oracle


def _actions(play: str, cavs: int, draw: np.random.Generator) -> NDArray[np.int64]:
    match play:
        case "random":
            return draw.integers(0, ACTIONS, cavs)
        case _:
            return np.full(cavs, {"idle": IDLE, "left": LEFT, "human": AS_HUMAN}[play], np.int64)


def trials(seeds: int) -> list[Trial]:
    """Return `seeds` trials per combination of road, behaviour and driver constants, with rotating
    density."""
    return [
        Trial(ramp_lanes, 1 + seed % 3, play, seed, eager=eager)
        for seed in range(seeds)
        for ramp_lanes in (1, 2)
        for play in PLAYS
        for eager in (False, True)
    ]


def run(words: Sequence[str]) -> int:
    """Print the largest differences; return 1 if a requirement is violated, else 0.

    Raises HeadwayError for an invalid number of seeds, or if highway-env is not installed."""
    given = words or ["25"]
    if len(given) > 1 or not given[0].isdigit() or int(given[0]) == 0:
        raise HeadwayError(f"the number of seeds must be one whole number above 0, not '{' '.join(given)}'")
    seeds = int(given[0])
    _oracle()
    print(f"{len(trials(seeds))} episodes on each, seeds 0 to {seeds - 1}\n")
    print(
        "| ramp lanes | CAVs | MOBIL | episodes | contacts | lane changes | free | per step | push | faults |"
    )
    print("|---:|---|---|---:|---:|---:|---:|---:|---:|---:|")
    faults = 0
    for ramp_lanes, play, eager in product((1, 2), PLAYS, (False, True)):
        group = (ramp_lanes, play, eager)
        mine = [trial for trial in trials(seeds) if (trial.ramp_lanes, trial.play, trial.eager) == group]
        verdicts = [compare(trial) for trial in mine]
        wrong = [(trial, v) for trial, v in zip(mine, verdicts, strict=True) if v.faults]
        faults += len(wrong)
        print(
            f"| {ramp_lanes} | {play} | {'study' if eager else 'highway-env'} | {len(mine)} "
            f"| {sum(v.contact for v in verdicts)} | {sum(v.lane_changes for v in verdicts)} "
            f"| {max(v.free for v in verdicts):.1e} | {max(v.stepwise for v in verdicts):.1e} "
            f"| {max(v.push for v in verdicts):.1e} | {len(wrong)} |",
            flush=True,
        )
        for trial, verdict in wrong[:3]:
            print(f"  {trial}: {verdict.faults[0]}")
    return 1 if faults else 0


def main() -> None:
    """Run the comparison and exit; an error is one line and exit code 2."""
    try:
        sys.exit(run(sys.argv[1:]))
    except HeadwayError as error:
        print(f"merge_parity: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()

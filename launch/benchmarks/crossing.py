"""The intersection: traffic compared with an independent reconstruction, speed compared with bare SUMO,
memory.

Expected values are from Flow's intersection, rebuilt once on SUMO 1.28 without this project; `BANDS` are the
tolerated differences between two samples. All rows are of controllers without learning.
"""

import resource
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations, child_seeds
from headway.registry import env_entry

PAPER: Mapping[str, Any] = {
    "observation": "paper",
    "av_speed_mode": 1,
    "hdv_speed_mode": 1,
    "human_noise": 0.2,
    "on_collision": "end_episode",
    "at_exit": "terminated",
}
"""Flow's settings, but with patient drivers, as in the reconstruction; rewards do not affect the traffic."""
LIGHT: Mapping[str, Any] = {"vph_per_lane_hdv": 100.0, "vph_per_lane_av": 100.0}
METRICS = ("length", "collisions", "inflow_vph", "outflow_vph", "vehicles", "speed", "fuel_gal_s")
BANDS: Mapping[str, tuple[float, float]] = {
    "length": (0.30, 200.0),
    "collisions": (0.20, 0.5),
    "inflow_vph": (0.08, 0.0),
    "outflow_vph": (0.15, 100.0),
    "vehicles": (0.20, 1.0),
    "speed": (0.12, 0.3),
    "fuel_gal_s": (0.15, 0.0),
}
"""(relative, absolute) parts of the tolerance, which add up. Episodes that end at the first collision vary
most: the standard error of their length is about the length over the root of ten seeds."""


@dataclass(frozen=True)
class Scenario:
    """One row: controller, demand, and the expected metrics of the reconstruction."""

    name: str
    controller: str | float
    """Name of a rule, or mean of random accelerations with standard deviation 1, m/s^2."""
    arguments: Mapping[str, Any]
    seeds: int
    expected: Mapping[str, float] = field(default_factory=dict)


def _expected(*values: float | None) -> dict[str, float]:
    return {name: value for name, value in zip(METRICS, values, strict=True) if value is not None}


SCENARIOS = (
    Scenario("drawn from N(0, 1)", 0.0, PAPER, 10, _expected(1182, 0.60, 3043, 642, 40.5, 5.72, 0.000215)),
    Scenario(
        "the same, 1,600 veh/h", 0.0, {**PAPER, **LIGHT}, 10,
        _expected(1179, 0.40, 1444, 450, 17.7, 6.73, 0.000241),
    ),
    Scenario("drawn from N(1, 1)", 1.0, PAPER, 10, _expected(624, 1.0, 3071, 989, 19.0, 11.2, 0.000414)),
    Scenario("+3 m/s^2", "full_throttle", PAPER, 10, _expected(865, 0.80, 3115, 1627, 19.2, 13.9, 0.00062)),
    Scenario(
        "the same, 1,600 veh/h", "full_throttle", {**PAPER, **LIGHT}, 10,
        _expected(1246, 0.20, 1417, 1008, 8.8, 15.4, 0.000666),
    ),
    Scenario(
        "humans who do not yield, 1,600 veh/h", "human_mode1", {**PAPER, **LIGHT}, 10,
        _expected(1268, 0.50, 1558, 1081, 9.9, 14.9, 0.000518),
    ),
    Scenario(
        "humans, 1,600 veh/h", "human", {**PAPER, **LIGHT}, 10,
        _expected(1500, 0, 1548, 1006, 15.0, 10.4, 0.000383),
    ),
    Scenario("humans", "human", PAPER, 10, _expected(1500, 0, 3226, 1361, 42.5, 7.1, 0.000294)),
    Scenario(
        "SUMO's humans, 1,600 veh/h", "human", LIGHT, 30,
        _expected(1500, 0, None, 1074, 14.6, 11.45, None),
    ),
    Scenario(
        "SUMO's humans, right before left", "human", {**LIGHT, "junction": "right_before_left"}, 30,
        _expected(1500, 0, None, 740, 20.8, 7.75, None),
    ),
    Scenario(
        "SUMO's humans, all-way stop", "human", {**LIGHT, "junction": "allway_stop"}, 30,
        _expected(1500, 0, None, 1185, None, 11.6, None),
    ),
    Scenario("SUMO's humans", "human", {}, 30, _expected(1500, 0, None, 1466, 41.0, 7.54, None)),
)  # fmt: skip


def run_episodes(scenario: Scenario, episodes: int | None = None) -> dict[str, float]:
    """Return mean metrics over `episodes` episodes (None: the scenario's number of seeds), with `length`."""
    entry = env_entry("intersection")
    prepared = entry.prepare(entry.config(**scenario.arguments))
    rows = []
    with closing(entry.make(prepared, 1)) as env:
        for seed in child_seeds(17, "traffic", 0, episodes or scenario.seeds):
            act = _driver(scenario.controller, prepared, int(seed))
            observed, length, ended = env.reset(np.array([seed])), 0, False
            while not ended:
                outcome, observed = env.step(act(env, observed))
                length, ended = length + 1, bool(outcome.episode_ended[0])
            named = zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True)
            rows.append({"length": float(length), **dict(named)})
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _driver(
    controller: str | float, prepared: object, seed: int
) -> Callable[[BatchedEnv, Observations], NDArray[np.float32]]:
    if isinstance(controller, str):
        return env_entry("intersection").rules[controller].make(prepared).act
    draw, mean = np.random.default_rng(seed), controller

    def act(env: BatchedEnv, observed: Observations) -> NDArray[np.float32]:
        return draw.normal(mean, 1.0, (*observed.alive.shape, 1)).astype(np.float32)

    return act


def outside(scenario: Scenario, found: Mapping[str, float], episodes: int | None = None) -> list[str]:
    """Return the metrics outside their bands. For fewer episodes than the scenario's, bands are wider by the
    root of the ratio."""
    wider = float(np.sqrt(scenario.seeds / (episodes or scenario.seeds)))
    return [
        name
        for name, expected in scenario.expected.items()
        if abs(found[name] - expected) > wider * (BANDS[name][0] * expected + BANDS[name][1])
    ]


def report() -> None:
    """Print the tables."""
    print("\n## The intersection: traffic compared with an independent reconstruction\n")
    print(f"| controller | {' | '.join(METRICS)} | outside its band |")
    print(f"|---|{'---:|' * len(METRICS)}---|")
    for scenario in SCENARIOS:
        found = run_episodes(scenario)
        cells = [
            f"{found[name]:.4g} ({scenario.expected[name]:.4g})"
            if name in scenario.expected
            else f"{found[name]:.4g}"
            for name in METRICS
        ]
        print(
            f"| {scenario.name} | {' | '.join(cells)} | {', '.join(outside(scenario, found))} |", flush=True
        )
    print("\nIn brackets: reconstruction. The first rows end at the first collision and have noisy humans.")
    _report_speed()
    _report_memory()


def _report_speed() -> None:
    """Print the speed of the environment, and of SUMO with only the same commands and readings."""
    print("\n| demand | vehicles | steps/CPU s | SUMO with the same commands and getters | overhead |")
    print("|---|---:|---:|---:|---:|")
    for name, arguments in (("1,600 veh/h", LIGHT), ("3,200 veh/h", {})):
        full, bare, overhead, vehicles = speeds(arguments)
        print(f"| {name} | {vehicles:.1f} | {full:,.0f} | {bare:,.0f} | {overhead:.0%} |", flush=True)


def speeds(
    arguments: Mapping[str, Any], rounds: int = 15, steps: int = 1000
) -> tuple[float, float, float, float]:
    """Return steps per CPU second of the environment and of bare SUMO, the environment's overhead as a share
    of bare SUMO's time, and the number of vehicles at the end. The first three are medians of interleaved
    rounds over the same episode."""
    from headway_envs.intersection.env import IntersectionBatchedEnv

    entry = env_entry("intersection")
    env = entry.make(entry.prepare(entry.config(**arguments)), 1)
    assert isinstance(env, IntersectionBatchedEnv)
    seconds: dict[str, list[float]] = {"full": [], "bare": []}
    actions = np.full((1, env.spec.num_agents, 1), 0.5, np.float32)
    with closing(env):
        for _ in range(rounds):
            env.reset(np.array([3], np.uint64))
            began = time.process_time()
            for _ in range(steps):
                env.step(actions)
            seconds["full"].append(time.process_time() - began)
            vehicles = len(env.bridge.roster)
            env.reset(np.array([3], np.uint64))
            began = time.process_time()
            assert _step_bare(env.bridge.simulation.sumo, env.config, steps, 0.5) == vehicles
            seconds["bare"].append(time.process_time() - began)
    full, bare = (np.array(each) for each in seconds.values())
    overhead = np.median(full / bare) - 1
    return steps / float(np.median(full)), steps / float(np.median(bare)), float(overhead), float(vehicles)


def _step_bare(sumo: Any, config: Any, steps: int, acceleration: float) -> int:  # noqa: ANN401 - libsumo
    """Run SUMO with the environment's commands and readings only; return the number of vehicles at the
    end."""
    world, vehicle = sumo.simulation, sumo.vehicle
    speed: dict[str, float] = {}
    for _ in range(steps):
        for name, before in speed.items():
            if name.startswith("av"):
                vehicle.setSpeed(name, before + acceleration * 0.1)
        world.step()
        world.getCollisions()
        for name in world.getArrivedIDList():
            del speed[name]
        for name in world.getDepartedIDList():
            automated = name.startswith("av")
            vehicle.setSpeedMode(name, config.av_speed_mode if automated else config.hdv_speed_mode)
            if automated:
                vehicle.setLaneChangeMode(name, config.av_lane_change_mode)
            speed[name] = 0.0
        world.getLoadedNumber()
        speed = {name: vehicle.getSpeed(name) for name in speed}
        for name in speed:
            vehicle.getDistance(name)
            vehicle.getFuelConsumption(name)
            if name.startswith("av"):
                vehicle.getLeader(name, 200.0)
                vehicle.getFollower(name, 200.0)
    return len(speed)


def _report_memory(resets: int = 1000) -> None:
    entry = env_entry("intersection")
    with closing(entry.make(entry.prepare(entry.config(horizon=5)), 1)) as env:
        env.reset(np.array([3], np.uint64))
        actions = np.zeros((1, env.spec.num_agents, 1), np.float32)
        marks = []
        for reset in range(resets):
            if reset in (resets // 10, resets - 1):
                marks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
            for _ in range(5):
                env.step(actions)
    print(
        f"\nMemory of a process with the intersection: {marks[1]:.0f} MB at most, "
        f"{marks[1] - marks[0]:.1f} MB of it since reset {resets // 10} of {resets:,}."
    )

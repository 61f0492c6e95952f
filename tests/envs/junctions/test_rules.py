"""Traffic lights under the rules, and human drivers."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from headway_envs.junctions.entry import ENTRY
from headway_envs.sumo_simulation import Simulation, libsumo

Open = Callable[..., Any]
SEED = np.array([3], np.uint64)


def _states(env: Any, rule: str, steps: int, light: str = "centre") -> list[str]:  # noqa: ANN401 - an environment
    """Return the state of a traffic light in each step under a rule."""
    controller, observed, found = ENTRY.rules[rule].make(env.prepared), env.reset(SEED), []
    for _ in range(steps):
        _, observed = env.step(controller.act(env, observed))
        found.append(libsumo().trafficlight.getRedYellowGreenState(light))
    return found


@pytest.mark.parametrize(
    ("rule", "demand", "greens"),
    [
        ("signal", "400x1000", (25, 25)),
        ("signal_best", "400x1000", (25, 11)),
        ("signal_best", "300x300", (25, 25)),
    ],
)
def test_signals_have_fixed_greens(rule: str, demand: str, greens: tuple[int, int], junctions: Open) -> None:
    vertical, horizontal = greens
    cycle = ["GrGr"] * 2 * vertical + ["rGrG"] * 2 * horizontal
    assert _states(junctions(demand=demand), rule, 200) == (cycle * 4)[:200]


@pytest.mark.parametrize("offset", [0, 7, -3, 130])
def test_fixed_signals_are_those_of_sumo(offset: int, junctions: Open, tmp_path: Path) -> None:
    """The rule sets each state; SUMO runs the program of the network by itself."""
    plain = junctions().prepared
    text = Path(plain.network.path).read_text(encoding="utf-8")
    network, demand = tmp_path / "lights.net.xml", tmp_path / "my.rou.xml"
    network.write_text(text.replace('offset="0"', f'offset="{offset}"'), encoding="utf-8")
    demand.write_text(plain.routes[0], encoding="utf-8")
    by_itself, alone = [], Simulation(str(network), {"step-length": "0.5"})
    alone.begin(1, plain.routes[0])
    for _ in range(300):
        alone.step()
        by_itself.append(libsumo().trafficlight.getRedYellowGreenState("centre"))
    alone.close()
    env = junctions(network=str(network), demand=str(demand), lead_in_s=0)
    assert _states(env, "signal", 300) == by_itself


def test_lights_are_off_under_other_rules(junctions: Open) -> None:
    assert set(_states(junctions(), "human", 50)) == {"OoOo"}


def test_max_pressure_gives_green_to_the_fuller_road(junctions: Open) -> None:
    env, sumo, chosen = junctions(demand="200x900"), libsumo(), [""]
    controller, observed = ENTRY.rules["max_pressure"].make(env.prepared), env.reset(SEED)
    for step in range(480):
        count = sumo.lane.getLastStepVehicleNumber
        sides = {
            "GrGr": sum(count(f"{name}_in_0") - count(f"{name}_out_0") for name in ("north", "south")),
            "rGrG": sum(count(f"{name}_in_0") - count(f"{name}_out_0") for name in ("east", "west")),
        }
        _, observed = env.step(controller.act(env, observed))
        shown = sumo.trafficlight.getRedYellowGreenState("centre")
        if step and step % 24 == 0:
            assert sides[shown] == max(sides.values())
        elif step:
            assert shown == chosen[-1]
        chosen.append(shown)
    assert set(chosen[1:]) == {"GrGr", "rGrG"}


@pytest.mark.parametrize("step_s", [0.5, 0.3])
def test_max_pressure_shows_yellow_where_the_program_does(
    step_s: float, junctions: Open, grid: tuple[Path, Path]
) -> None:
    env = junctions(network=str(grid[0]), demand=str(grid[1]), step_s=step_s)
    states = _states(env, "max_pressure", round(300 / step_s), "A0")
    yellow_s = min(length for length, state in env.prepared.network.signals["A0"].phases if "y" in state)
    runs = "".join("y" if "y" in state else "-" for state in states).replace("-", " ").split()
    assert len(runs) > 2
    assert {len(run) for run in runs} == {round(yellow_s / step_s)}


@pytest.mark.parametrize(
    ("states", "shown"), [(("rrrr", "GrGr", "rGrG"), {"GrGr", "rGrG"}), (("oooo", "yyyy"), {"OoOo"})]
)
def test_max_pressure_chooses_among_phases_with_green(
    states: tuple[str, ...], shown: set[str], junctions: Open
) -> None:
    env = junctions(demand="700x700")
    network = env.prepared.network
    light = replace(network.signals["centre"], phases=tuple((5.0, state) for state in states))
    env.prepared = replace(env.prepared, network=replace(network, signals={"centre": light}))
    assert set(_states(env, "max_pressure", 200)) == shown


@pytest.mark.parametrize("rule", ["signal", "signal_best", "max_pressure"])
def test_without_lights_vehicles_obey_the_right_of_way(
    rule: str, junctions: Open, merge: tuple[Path, Path]
) -> None:
    driven = []
    for name in (rule, "human"):
        env = junctions(network=str(merge[0]), demand=str(merge[1]))
        controller, observed = ENTRY.rules[name].make(env.prepared), env.reset(SEED)
        for _ in range(200):
            _, observed = env.step(controller.act(env, observed))
        driven.append([vehicle.speed for vehicle in env.traffic.vehicles.values()])
        env.close()
    assert driven[0] == driven[1]


@pytest.mark.parametrize("share", [0.333, 1.0])
def test_avs_stop_human_drivers_at_a_virtual_signal(share: float, junctions: Open) -> None:
    """Only vehicles that cannot stop cross at red, and almost as many leave as under a real signal."""
    env = junctions(horizon=1000, hdv_speed_mode=1, automated_share=share)
    controller, observed = ENTRY.rules["virtual_signal"].make(env.prepared), env.reset(SEED)
    for step in range(1000):
        red = 1 - step // 50 % 2  # the parity of the approaches that have red: north is 0
        before = {
            name: (vehicle.speed, vehicle.distance)
            for name, vehicle in env.traffic.vehicles.items()
            if vehicle.slot >= 0 and vehicle.distance >= 0 and vehicle.approach % 2 == red
        }
        outcome, observed = env.step(controller.act(env, observed))
        for name, (speed, distance) in before.items():
            vehicle = env.traffic.vehicles.get(name)
            if vehicle is not None and vehicle.distance < 0:
                assert speed**2 / 7 > distance
    found = dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))
    assert set(libsumo().trafficlight.getRedYellowGreenState("centre")) == set("oO")
    assert found["collided_vehicles"] == 0
    assert found["outflow_vph"] > 2600


def test_avs_that_accept_gaps_need_only_their_observation(junctions: Open) -> None:
    """Equal observations have equal actions, so a policy can imitate the rule; it lets through almost as many
    vehicles as a signal."""
    env = junctions(horizon=1000, hdv_speed_mode=1)
    controller, observed = ENTRY.rules["gap_acceptance"].make(env.prepared), env.reset(SEED)
    chosen: dict[bytes, int] = {}
    for _ in range(1000):
        actions = controller.act(env, observed)
        for slot in np.flatnonzero(observed.alive[0]):
            key = observed.observations[0, slot].tobytes()
            assert chosen.setdefault(key, actions[0, slot]) == actions[0, slot]
        outcome, observed = env.step(actions)
    found = dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))
    assert set(chosen.values()) == {0, 2}
    assert found["collided_vehicles"] == 0
    assert found["outflow_vph"] > 2500


def test_without_lights_every_other_approach_conflicts(junctions: Open, merge: tuple[Path, Path]) -> None:
    env = junctions(network=str(merge[0]), demand=str(merge[1]), automated_share=1.0)
    controller, observed = ENTRY.rules["gap_acceptance"].make(env.prepared), env.reset(SEED)
    braked = False
    for _ in range(200):
        actions = controller.act(env, observed)
        braked |= bool((actions[observed.alive] == 0).any())
        outcome, observed = env.step(actions)
        assert outcome.rewards.min() >= 0  # no collision
    assert braked


def test_human_drivers_yield_and_ignore_actions(junctions: Open) -> None:
    def left(rule: str) -> float:
        env = junctions(horizon=600, warm_up_s=0)
        controller, observed = ENTRY.rules[rule].make(env.prepared), env.reset(SEED)
        for _ in range(600):
            outcome, observed = env.step(controller.act(env, observed))
        env.close()
        found = dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True))
        assert found["collided_vehicles"] == 0
        return found["outflow_vph"]

    assert left("human") > left("human_mode1") + 50

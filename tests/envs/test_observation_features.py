"""The described numbers of observations are, times their scale, what the simulations hold in those units."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.contracts import BatchedEnv
from headway_envs.bus.config import BusConfig
from headway_envs.bus.parallel import BusParallelEnv
from headway_envs.registry import ENTRIES

Quantities = Mapping[str, float]
"""Expected quantities, in their units, by the names of features."""


def made(name: str, copies: int = 1, **arguments: Any) -> Any:  # noqa: ANN401 - an environment with its world
    if name in ("intersection", "junctions"):
        pytest.importorskip("libsumo", reason="SUMO (headway[sumo]) is not installed")
    entry = ENTRIES[name]
    return entry.make(entry.prepare(entry.config(**arguments)), copies)


def measured(env: BatchedEnv, row: NDArray[np.float32]) -> dict[str, float]:
    """Return an observation's quantities in their units, by name."""
    features = env.spec.observation_features
    return {
        feature.name: float(number) * feature.scale for feature, number in zip(features, row, strict=True)
    }


def assert_holds(env: BatchedEnv, row: NDArray[np.float32], expected: Quantities) -> None:
    found = measured(env, row)
    wanted = {name: float(value) for name, value in expected.items()}
    assert {name: found[name] for name in wanted} == pytest.approx(wanted, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("name", ENTRIES)
def test_every_environment_describes_each_number_of_its_observations(name: str) -> None:
    spec = made(name).spec
    names = [feature.name for feature in spec.observation_features]
    assert len(names) == len(set(names)) == spec.observation_size
    assert all(feature.meaning and feature.scale > 0 for feature in spec.observation_features)


@pytest.mark.parametrize("name", ["merge", "merge_two_lane"])
def test_positions_and_velocities_of_a_merge(name: str) -> None:
    env = made(name, copies=4)
    observed, draw = env.reset(np.arange(4, dtype=np.uint64)), np.random.default_rng(0)
    seen = set()
    for _ in range(40):
        for copy, agent in np.argwhere(observed.alive):
            cars = env.world.cars[copy][: env.world.episodes[copy]["cars"]]
            expected = {"present": 1.0, **moving(cars[agent])}
            nearest = sorted(range(len(cars)), key=lambda i: (abs(cars[i]["x"] - cars[agent]["x"]), i))
            others = [
                cars[i]
                for i in nearest
                if i != agent
                and math.dist((cars[i]["x"], cars[i]["y"]), (cars[agent]["x"], cars[agent]["y"])) < 180
            ]
            for number in range(1, 5):
                there = number <= len(others)
                relative = {
                    key: value - expected[key] if there else 0.0
                    for key, value in moving(others[number - 1] if there else cars[agent]).items()
                }
                expected |= {f"near_{number}_{key}": value for key, value in relative.items()}
                expected[f"near_{number}_present"] = float(there)
                seen.add(there)
            assert len(expected) == env.spec.observation_size
            assert_holds(env, observed.observations[copy, agent], expected)
        _, observed = env.step(draw.integers(0, 5, observed.alive.shape))
    assert seen == {True, False}


def moving(car: Any) -> dict[str, float]:  # noqa: ANN401 - a record
    """Return position and velocity of a vehicle."""
    speeds = {
        "speed_x": car["speed"] * math.cos(car["heading"]),
        "speed_y": car["speed"] * math.sin(car["heading"]),
    }
    return {"x": float(car["x"]), "y": float(car["y"]), **{key: float(v) for key, v in speeds.items()}}


STANDING, TERMINAL, DISPATCHED, AWAY, BROKEN = 4, 1, 2, 5, 6


def test_states_of_buses() -> None:
    """The features that need no interpolation of the scenario's tables."""
    env = made("bus", copies=2, start_hour=6, end_hour=10, capacity=60)
    network, draw = env.network, np.random.default_rng(0)
    observed = env.reset(np.arange(2, dtype=np.uint64))
    phases = set()
    for _ in range(200):
        for copy, agent in np.argwhere(observed.alive):
            slot, now = env.world.slots[copy, agent], float(env.world.days[copy]["now"])
            line = env.world.lines[copy, network.slot_line[agent]]
            phase = int(slot["phase"])
            phases.add(phase)
            first, last = (
                network.pattern_calls[slot["pattern"]],
                network.pattern_calls[slot["pattern"] + 1] - 1,
            )
            place = (slot["call"] - first) / (last - first)
            departure, turn = float(network.trip_departure[slot["trip"]]), 2 * math.pi * now / 86_400
            expected = {
                "time": now - 6 * 3600,
                "load": slot["load"],
                "uptime": slot["uptime"],
                "fuel": slot["fuel"],
                "stop": place,
                "next_stop": min(place + 1 / (last - first), 1),
                "spacing_ahead": 0.0 if math.isnan(slot["ahead"]) else min(slot["ahead"], 3) - 1,
                "spacing_behind": 0.0 if math.isnan(slot["behind"]) else min(slot["behind"], 3) - 1,
                "last_headway": min(max(slot["headway_ratio"] - 1, -1), 2),
                "lateness": min(max(now - departure - slot["place"], -3600), 3600),
                "at_stop": phase == STANDING,
                "at_terminal": phase in (TERMINAL, DISPATCHED),
                "out_of_service": phase in (AWAY, BROKEN),
                "day_sine": math.sin(turn),
                "day_cosine": math.cos(turn),
                "held": min(slot["held"], 900),
                "until_event": min(env.world.event_time[copy, agent] - now, 300),
                "until_departure": min(max(departure - now, -1200), 1200) if phase == TERMINAL else 0,
                "pattern": slot["pattern"] - network.line_patterns[network.slot_line[agent]],
                "work_left": max(network.trip_work_left[slot["trip"]] - slot["place"], 0),
                "line_service": line["service"],
                "line_regularity": line["regularity"],
            }
            ahead, behind = expected["spacing_ahead"], expected["spacing_behind"]
            expected["spacing_difference"] = (ahead - behind) / 2
            assert_holds(env, observed.observations[copy, agent], expected)
        _, observed = env.step(draw.integers(0, 2, observed.alive.shape))
    assert {STANDING, TERMINAL} <= phases


def test_the_space_of_a_bus_holds_the_numbers_of_all_patterns_of_a_line() -> None:
    prepared = ENTRIES["bus"].prepare(BusConfig(end_hour=7))
    for patterns, high in ((2, 5.0), (6, 5.0), (9, 8.0)):
        network = prepared.network._replace(line_patterns=np.array([0, patterns]))
        env = BusParallelEnv(replace(prepared, network=network))
        assert env.observation_space(env.possible_agents[0]).high.tolist() == [high] * 29


@pytest.mark.parametrize("kind", ["scaled", "raw"])
def test_states_of_published_buses(kind: str) -> None:
    env = made("bus_published", copies=2, scenario="line", observation=kind)
    observed, draw = env.reset(np.arange(2, dtype=np.uint64)), np.random.default_rng(0)
    for _ in range(100):
        for copy, agent in np.ndindex(2, env.spec.num_agents):
            bus = env.world.buses[copy, agent]
            expected = {"clock": min(bus["clock"], 86_400)}
            expected |= {name: bus[name] for name in ("occupancy", "uptime", "stop")}
            assert_holds(env, observed.observations[copy, agent], expected)
            found = measured(env, observed.observations[copy, agent])
            demand = env.network.demand[round(found["next_stop"])]
            assert found["demand"] == pytest.approx(demand, rel=1e-4)
        _, observed = env.step(draw.integers(0, 2, (2, env.spec.num_agents)))


def test_the_shorter_observations_of_buses_are_parts_of_the_whole_one() -> None:
    kinds = ("control", "published", "paper")
    envs = {kind: made("bus", observation=kind) for kind in kinds}
    seen = {kind: env.reset(np.zeros(1, np.uint64)) for kind, env in envs.items()}
    for _ in range(30):
        for agent in np.flatnonzero(seen["control"].alive[0]):
            rows = {kind: measured(envs[kind], seen[kind].observations[0, agent]) for kind in kinds}
            for kind in kinds[1:]:
                assert rows[kind] == pytest.approx({name: rows["control"][name] for name in rows[kind]})
        actions = np.ones(seen["control"].alive.shape, np.int64)
        seen = {kind: env.step(actions)[1] for kind, env in envs.items()}

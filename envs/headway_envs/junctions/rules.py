"""Controllers for comparison: human drivers, traffic lights that they obey, and automated vehicles that
follow a rule."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Observations
from headway_envs.junctions.env import SIGHT_M, JunctionsBatchedEnv
from headway_envs.junctions.network import Signal
from headway_envs.junctions.prepared import Prepared
from headway_envs.junctions.traffic import ACCELERATIONS

ALL_CHECKS, SAFE_GAP_ONLY = 31, 1
"""SUMO's speed modes: all checks, including right of way; only a safe gap to the leader."""
BEST_GREENS_S: Mapping[tuple[int, int], tuple[float, float]] = {
    (1000, 400): (25, 11), (1000, 550): (25, 14), (1000, 700): (29, 22), (1000, 850): (25, 25),
    (850, 400): (25, 25), (850, 550): (25, 25), (850, 700): (25, 25), (850, 850): (28, 28),
    (850, 1000): (25, 25), (700, 700): (25, 25), (700, 850): (25, 25), (700, 1000): (22, 29),
    (550, 850): (25, 25), (550, 1000): (14, 25), (400, 850): (25, 25), (400, 1000): (11, 25),
}  # fmt: skip
"""Greens of the horizontal and the vertical road, s, by demand, vehicles per hour and direction, that Yan and
Wu found best."""
_BRAKE, _KEEP, _ACCELERATE = range(3)
STOP_M = 3.0
"""Distance to the line at which an AV stops, m."""
BETWEEN_DECISIONS_S = 12.0
"""Time between two decisions of max pressure, s: the best of Yan and Wu."""


def _require_junctions(env: BatchedEnv) -> JunctionsBatchedEnv:
    if not isinstance(env, JunctionsBatchedEnv):
        raise TypeError(f"the junctions' rules need a JunctionsBatchedEnv, not {type(env).__name__}")
    return env


def _no_actions(observed: Observations) -> NDArray[np.int64]:
    return np.full(observed.alive.shape, _KEEP, np.int64)


def _is_green(state: str) -> bool:
    """Return whether a state of a traffic light has green, and no yellow as between two phases."""
    return "g" in state.lower() and "y" not in state.lower()


@dataclass(frozen=True)
class Humans:
    """SUMO drives all vehicles as humans, including the automated ones."""

    prepared: Prepared
    right_of_way: bool
    """True: drivers apply all checks, including right of way. False: only a safe gap to the leader."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return actions (1, N), which the environment ignores."""
        mode = ALL_CHECKS if self.right_of_way else SAFE_GAP_ONLY
        _require_junctions(env).traffic.hand_over(mode)
        return _no_actions(observed)


class FixedSignal:
    """Traffic lights with fixed times, which all vehicles obey as humans do. At junctions without a light
    they obey the right of way."""

    def __init__(self, prepared: Prepared, best: bool = False) -> None:
        """`best`: the greens that Yan and Wu found best for the demand, where they are known, instead of
        those in the network's file."""
        self.prepared, signals = prepared, prepared.network.signals
        vph = prepared.config.vph if best else ()
        self._signals = [_with_greens(signals, BEST_GREENS_S.get(pair)) for pair in vph] or [signals]
        """Traffic lights of each demand, or those of all."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return actions (1, N), which the environment ignores."""
        native = _require_junctions(env)
        native.traffic.hand_over(ALL_CHECKS)
        for name, state in self._states(native).items():
            native.traffic.set_signal(name, state)
        return _no_actions(observed)

    def _states(self, env: JunctionsBatchedEnv) -> dict[str, str]:
        """Return the present state of each traffic light."""
        found = {}
        for name, signal in self._signals[env.demand % len(self._signals)].items():
            ends = np.cumsum([length for length, _ in signal.phases])
            place = (env.steps_taken * env.config.step_s - signal.offset) % ends[-1]
            found[name] = signal.phases[int(np.searchsorted(ends, place, side="right"))][1]
        return found


def _with_greens(signals: Mapping[str, Signal], greens: tuple[float, float] | None) -> Mapping[str, Signal]:
    """Return the one signal of the packaged network with other greens of the horizontal and the vertical
    road, s; None: unchanged."""
    if greens is None:
        return signals
    [(name, signal)] = signals.items()
    phases = zip(reversed(greens), (state for _, state in signal.phases), strict=True)
    return {name: replace(signal, phases=tuple(phases))}


class VirtualSignal(FixedSignal):
    """Traffic lights with the greens of `signal_best` that only AVs observe, and thereby impose on the human
    drivers behind them (Ferreira et al. 2010, "Self-organized traffic control").

    An AV at red stops before the line, unless it is too close; otherwise it accelerates."""

    def __init__(self, prepared: Prepared) -> None:
        super().__init__(prepared, best=True)
        self._links = {
            before: [(name, place) for place, link in enumerate(signal.links) if link[0] == before]
            for name, signal in prepared.network.signals.items()
            for before, _ in signal.links
        }

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return actions (1, N)."""
        native = _require_junctions(env)
        states, actions = self._states(native), np.full(observed.alive.shape, _ACCELERATE, np.int64)
        lanes = self.prepared.network.approaches
        for vehicle in native.traffic.vehicles.values():
            if vehicle.slot < 0 or vehicle.approach < 0 or vehicle.distance < 0:
                continue
            links = self._links.get(lanes[vehicle.approach], [])
            red = bool(links) and not any(states[name][place] in "gG" for name, place in links)
            if red and _must_brake(vehicle.speed, vehicle.distance, native.config.step_s):
                actions[0, vehicle.slot] = _BRAKE
        return actions


class GapAcceptance:
    """AVs that give way to the platoons of conflicting approaches and go in the gap behind them, as drivers
    at a minor road do. At the packaged crossing they need only their observations, so policies can imitate
    them.

    An AV stops before the line while human drivers cross whose platoon ends nearer than `PLATOON_M`, or while
    the first AV of a conflicting approach drives nearer than `COMING_M`; it goes first if that one stands.
    Approaches with green in the same phase of the network's traffic light do not conflict.
    """

    PLATOON_M, COMING_M, STANDING = 40.0, 15.0, 1.0
    """Distances to the junction, m, and the speed up to which an AV waits, m/s. Chosen at 700x700."""

    def __init__(self, prepared: Prepared) -> None:
        network = self.network = prepared.network
        self._places: list[list[int]] = []
        """Places of the conflicting approaches in an observation, by approach."""
        together = {
            frozenset((one, another))
            for signal in network.signals.values()
            for _, state in signal.phases
            for (one, _), light in zip(signal.links, state, strict=True)
            for (another, _), other_light in zip(signal.links, state, strict=True)
            if light in "gG" and other_light in "gG"
        }
        for lane, others in zip(network.approaches, network.others.tolist(), strict=True):
            lanes = [network.approaches[number] if number >= 0 else lane for number in others]
            self._places.append(
                [2 + 3 * k for k, other in enumerate(lanes) if frozenset((lane, other)) not in together]
            )

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return actions (1, N)."""
        native = _require_junctions(env)
        actions = np.full(observed.alive.shape, _ACCELERATE, np.int64)
        distances, speeds = np.split((observed.observations[0] + 1) / 2, 2, axis=1)
        distances, speeds = distances * SIGHT_M, speeds * self.network.speed_limit
        crossing = (distances > 0) & (distances < self.PLATOON_M)
        coming = (distances < self.COMING_M) & (speeds > self.STANDING)
        for vehicle in native.traffic.vehicles.values():
            if vehicle.slot < 0 or vehicle.approach < 0 or vehicle.distance < 0:
                continue
            slot, places = vehicle.slot, self._places[vehicle.approach]
            if (crossing[slot, places].any() or coming[slot, [place + 1 for place in places]].any()) and (
                _must_brake(vehicle.speed, vehicle.distance, native.config.step_s)
            ):
                actions[0, slot] = _BRAKE
        return actions


def _must_brake(speed: float, distance: float, step_s: float) -> bool:
    """Return whether a vehicle can still stop before the line, but not after one more step of
    acceleration."""
    next_speed = speed + ACCELERATIONS[_ACCELERATE] * step_s
    left = distance - next_speed * step_s - STOP_M
    return _stopping_m(speed) <= distance and _stopping_m(next_speed) > left


def _stopping_m(speed: float) -> float:
    return speed**2 / (-2 * ACCELERATIONS[_BRAKE])


class MaxPressure:
    """Traffic lights that give green, every 12 s, to the phase with the highest pressure: vehicles on the
    lanes before its links minus those on the lanes behind them (Varaiya 2013,
    doi:10.1016/j.trc.2013.08.014).

    A link that loses its green is yellow for as long as in the network's program. At junctions without a
    light, or with one that is never green, vehicles obey the right of way."""

    def __init__(self, prepared: Prepared) -> None:
        self._greens = {
            name: greens
            for name, signal in prepared.network.signals.items()
            if (greens := [state for _, state in signal.phases if _is_green(state)])
        }
        self._signals = {name: prepared.network.signals[name] for name in self._greens}
        self._shown: dict[str, str] = {}

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        """Return actions (1, N), which the environment ignores."""
        native = _require_junctions(env)
        traffic, step_s = native.traffic, native.config.step_s
        traffic.hand_over(ALL_CHECKS)
        # The tolerance absorbs rounding errors: 41 steps of 0.3 s are just under 12.3 s, a second decision.
        since = (native.steps_taken * step_s + 1e-9) % BETWEEN_DECISIONS_S
        for name, signal in self._signals.items():
            yellow_s = min((length for length, state in signal.phases if "y" in state.lower()), default=0.0)
            if native.steps_taken == 0:
                self._shown[name] = self._greens[name][0]
                traffic.set_signal(name, self._shown[name])
            elif since < step_s:
                before, after = self._shown[name], self._best(native, name)
                self._shown[name] = after
                yellow = "".join(
                    "y" if was in "gG" and then not in "gG" else was
                    for was, then in zip(before, after, strict=True)
                )
                traffic.set_signal(name, yellow if yellow_s else after)
            elif since >= yellow_s > since - step_s:
                traffic.set_signal(name, self._shown[name])
        return _no_actions(observed)

    def _best(self, env: JunctionsBatchedEnv, name: str) -> str:
        """Return the state with the highest pressure; the first of several."""
        links, count = self._signals[name].links, env.traffic.vehicles_on
        pressures = [count(before) - count(behind) for before, behind in links]
        return max(
            self._greens[name],
            key=lambda state: sum(
                pressure for pressure, light in zip(pressures, state, strict=True) if light in "gG"
            ),
        )

"""Spacings between the buses of a line."""

import numpy as np
from played import begun

from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.kernel.layout import DRIVING, KNOT_S, MOVE, STANDING
from headway_envs.bus.prepared import Prepared


def test_behind_the_last_bus_comes_the_next_to_leave_the_terminal(line: Prepared) -> None:
    """Expected departures of a day with many overdue trips are nearer to the actual than the planned ones.

    By the timetable, an overdue trip leaves at once, although its bus may still be under way.
    """
    env = begun(BusBatchedEnv(line, 1))
    net, slots = env.network, env.world.slots[0]
    left, expected = [], []
    for _ in range(line.config.ticks - 1):
        env.step(np.full((1, len(slots)), MOVE))
        now = env.world.days["now"][0]
        left.append(env.world.queues["last_departure"][0, net.pattern_calls[:-1]].copy())
        on_way = (slots["phase"] == DRIVING) | (slots["phase"] == STANDING)
        for pattern in np.unique(slots["pattern"][on_way]):
            last = min(slots[on_way & (slots["pattern"] == pattern)], key=lambda slot: slot["place"])
            target = np.interp(now - last["place"], KNOT_S, net.target[pattern])
            waiting = net.trip_departure[(net.trip_pattern == pattern) & ~env.world.departed[0]]
            planned = max(waiting.min(initial=np.inf), now)
            expected.append((len(left) - 1, pattern, now + last["behind"] * target - last["place"], planned))
    errors = []
    for tick, pattern, departure, planned in expected:
        later = [row[pattern] for row in left[tick:] if row[pattern] > left[tick][pattern]]
        if later and not np.isnan(departure):
            errors.append((abs(departure - later[0]), abs(planned - later[0])))
    assert len(errors) > 2000
    of_expected, of_timetable = np.mean(errors, axis=0)
    assert of_expected < of_timetable / 3

"""What follows from where all vehicles are: observations, reward terms and sums for the metrics; compiled.

Axes: V vehicles, N slots, L = 16 links (ways through the junction), D, S.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway_envs.compiling import compiled, compiled_apart, drop_stale_cache
from headway_envs.intersection.config import STEP_S, TERMS
from headway_envs.intersection.demand import MIN_GAP_M
from headway_envs.intersection.network import ROAD_M, SPEED_LIMIT

drop_stale_cache(Path(__file__).parent)  # constants of other files are compiled in, too

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]

SUMS = (
    "steps_all", "steps_av", "steps_hdv", "vehicles", "speed", "speed_av", "speed_hdv", "acceleration_av",
    "acceleration_hdv", "hardest_braking_av", "hardest_braking_hdv", "fuel", "standing",
)  # fmt: skip
"""What is added up for the metrics: steps with vehicles of a kind, and means over these."""
PAPER_SIZE = 6
WAY_SIZE = 8
NEAR_SIZE = 4
NEIGHBOURS = 4
"""Vehicles on crossing ways that an extended observation shows."""
NEIGHBOUR_SIZE = 6
EXTENDED_SIZE = PAPER_SIZE + WAY_SIZE + NEAR_SIZE + NEIGHBOURS * NEIGHBOUR_SIZE
LANES = 8
"""On which vehicles come; a link is of lane link // 2."""
CELLS = 4
"""Of 50 m on each approach, in the state."""
STATE_SIZE = 4 * (3 * CELLS + 2 + 2) + 2
STRONGEST = 3.0
"""Bound of a commanded acceleration, m/s^2."""
TARGET_SPEED = 20.0
_LONGEST_S = 20.0
"""Times of arrival are cut here, s."""
_NEAR_M = 50.0
"""Within which a distance matters to who is about to brake. Over the network's length, as in the paper's
observation, ten metres are next to nothing."""
_LONGEST_HEADWAY_S = 5.0
_LIKELY_SPEED = 3.0
"""Who drives slower, or stands, is ranked as if it came at this speed, m/s."""
_PAPER_GAINS = (1.0, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 0.0)
_EPSILON = 1e-5


class Crossing(NamedTuple):
    """What does not change."""

    link_length: Floats
    """(L,)"""
    foes: NDArray[np.bool_]
    """(L, L)"""
    yields: NDArray[np.bool_]
    """(L, L)"""
    weights: Floats
    """(8,): of the scaled terms."""
    total_length: float
    extended: bool


class Traffic(NamedTuple):
    """All vehicles, in rows 0 to V - 1 of arrays that are longer."""

    position: Floats
    """Front along the whole way: the stop line is at ROAD_M."""
    speed: Floats
    before: Floats
    """Speed one step before."""
    fuel: Floats
    """ml/s"""
    link: Whole
    slot: Whole
    """-1: driven by SUMO."""
    around: Floats
    """(V, 4): row of the vehicle ahead (-1: none) and its distance, the same of the one behind; valid where
    there is a slot."""


class Happened(NamedTuple):
    """What the step brought, beside places and speeds."""

    arrived: int
    crashes: int
    """Pairs of vehicles."""
    lane_changes: int
    """Of AVs."""
    outflow_vph: float
    """Since the episode's beginning."""
    pending: int
    """Vehicles that wait to enter."""
    passed: float
    """Share of the episode."""


class Seen(NamedTuple):
    """What is written."""

    observations: NDArray[np.float32]
    """(N, D)"""
    alive: NDArray[np.bool_]
    """(N,)"""
    state: NDArray[np.float32]
    """(S,)"""
    scaled: Floats
    """(8,): terms in [-1, 1], in the order of TERMS."""
    paper: Floats
    """(8,): the paper's terms with their gains."""
    rewards: Floats
    """(2,): scaled, and the paper's."""
    own: Floats
    """(N,): scaled, of each AV's own speed, standstill and headway; valid where `alive`."""
    sums: Floats
    """(len(SUMS),)"""
    present: Floats
    """(4,): steps that AVs have spent here, by approach."""
    first: Whole
    """(8,): the row of the first on each lane; -1: none. Room for the kernel to work in, as the next two."""
    soonest: Floats
    """(4,): when those arrive who come next on ways that cross one's own, s."""
    ranked: Whole
    """(4,): their rows; -1: nobody."""


_TRAFFIC = len(Crossing._fields)
_HAPPENED = _TRAFFIC + len(Traffic._fields)
_SEEN = _HAPPENED + len(Happened._fields)
"""Where each record begins among all of a step, one after another."""


@compiled
def _until_line(traffic: Traffic, row: int) -> float:
    """Time to the stop line at the speed of now, s, cut; 0 for who has passed it."""
    distance = max(ROAD_M - traffic.position[row], 0.0)
    seconds: float = distance / max(traffic.speed[row], 0.1)
    return min(seconds, _LONGEST_S)


@compiled
def _observe_paper(crossing: Crossing, traffic: Traffic, row: int, out: NDArray[np.float32]) -> None:
    """Section 5.2 of the paper: own place on its edge, speed, leader and follower; the fifth is taken over
    the speed limit, as in Flow, where the paper prints the length. The way through the junction is one
    edge."""
    position, inside = traffic.position[row], crossing.link_length[traffic.link[row]]
    if position >= ROAD_M + inside:
        position -= ROAD_M + inside
    elif position >= ROAD_M:
        position -= ROAD_M
    speed, around = traffic.speed[row], traffic.around[row]
    leader, follower = int(around[0]), int(around[2])
    out[0] = position / crossing.total_length
    out[1] = speed / SPEED_LIMIT
    lead_speed, lead_gap = SPEED_LIMIT, crossing.total_length
    if leader >= 0:
        lead_speed, lead_gap = traffic.speed[leader], around[1] + MIN_GAP_M
    follow_speed, follow_gap = 0.0, crossing.total_length
    if follower >= 0:
        follow_speed, follow_gap = traffic.speed[follower], around[3] + MIN_GAP_M
    out[2] = (lead_speed - speed) / SPEED_LIMIT
    out[3] = lead_gap / crossing.total_length
    out[4] = (speed - follow_speed) / SPEED_LIMIT
    out[5] = follow_gap / crossing.total_length


@compiled
def _observe_extended(
    crossing: Crossing, traffic: Traffic, count: int, row: int, seen: Seen, out: NDArray[np.float32]
) -> None:
    """Which part of the way (3), distance and time to the stop line, the turn (3); what is near (4): the stop
    line, the leader as distance and as time headway, the follower; then those who come next on ways that
    cross the own (`_show_crossing`)."""
    link, position, speed = traffic.link[row], traffic.position[row], traffic.speed[row]
    part = 0 if position < ROAD_M else (1 if position < ROAD_M + crossing.link_length[link] else 2)
    out[PAPER_SIZE + part] = 1.0
    left = max(ROAD_M - position, 0.0)
    out[PAPER_SIZE + 3] = left / ROAD_M
    out[PAPER_SIZE + 4] = _until_line(traffic, row) / _LONGEST_S
    turn = link % 4
    out[PAPER_SIZE + 5 + (turn if turn < 2 else turn - 1)] = 1.0
    near, around = PAPER_SIZE + WAY_SIZE, traffic.around[row]
    out[near] = min(left / _NEAR_M, 1.0)
    out[near + 1 : near + NEAR_SIZE] = 1.0
    if around[0] >= 0:
        gap = around[1] + MIN_GAP_M
        out[near + 1] = min(gap / _NEAR_M, 1.0)
        out[near + 2] = min(gap / max(speed, 0.1) / _LONGEST_HEADWAY_S, 1.0)
    if around[2] >= 0:
        out[near + 3] = min((around[3] + MIN_GAP_M) / _NEAR_M, 1.0)
    if part < 2:
        _show_crossing(crossing, traffic, count, row, seen, out[near + NEAR_SIZE :])


@compiled
def _show_crossing(
    crossing: Crossing, traffic: Traffic, count: int, row: int, seen: Seen, out: NDArray[np.float32]
) -> None:
    """Of all whose ways cross the own, those inside the junction and the first on each lane, four at most,
    the soonest first: 1, distance to their stop line (negative past it), speed, how much later they arrive,
    whether automated, whether they go first."""
    link = traffic.link[row]
    first, soonest, rows = seen.first, seen.soonest, seen.ranked
    first[:] = -1
    soonest[:] = np.inf
    rows[:] = -1
    for other in range(count):
        other_link = traffic.link[other]
        if not crossing.foes[link, other_link]:
            continue
        left = ROAD_M - traffic.position[other]
        if left > 0.0:
            lane = other_link // 2
            if first[lane] < 0 or left < ROAD_M - traffic.position[first[lane]]:
                first[lane] = other
        elif left > -crossing.link_length[other_link]:
            _insert(soonest, rows, left / max(traffic.speed[other], _LIKELY_SPEED), other)
    for head in first:
        if head >= 0:
            left = ROAD_M - traffic.position[head]
            _insert(soonest, rows, left / max(traffic.speed[head], _LIKELY_SPEED), int(head))
    mine, place = _until_line(traffic, row), 0
    for shown in rows:
        if shown < 0:
            return
        out[place] = 1.0
        out[place + 1] = (ROAD_M - traffic.position[shown]) / _NEAR_M
        out[place + 2] = traffic.speed[shown] / SPEED_LIMIT
        out[place + 3] = (_until_line(traffic, int(shown)) - mine) / _LONGEST_S
        out[place + 4] = 1.0 if traffic.slot[shown] >= 0 else 0.0
        out[place + 5] = 1.0 if crossing.yields[link, traffic.link[shown]] else 0.0
        place += NEIGHBOUR_SIZE


@compiled
def _insert(keys: Floats, rows: Whole, key: float, row: int) -> None:
    """Keep rows (n,) in the order of their keys (n,), the smallest first; the last drops out."""
    place = len(keys) - 1
    if key >= keys[place]:
        return
    while place > 0 and keys[place - 1] > key:
        keys[place], rows[place] = keys[place - 1], rows[place - 1]
        place -= 1
    keys[place], rows[place] = key, row


@compiled
def _describe(crossing: Crossing, traffic: Traffic, count: int, happened: Happened, seen: Seen) -> None:
    """The state: for each approach, AVs, HDVs and mean speed in each cell of the road, then vehicles inside
    the junction and beyond it with their mean speeds; the share of the episode passed, vehicles waiting."""
    state = seen.state
    state[:] = 0.0
    width = 3 * CELLS + 4
    for row in range(count):
        link, position, speed = traffic.link[row], traffic.position[row], traffic.speed[row]
        base = link // 4 * width
        if position < ROAD_M:
            place = base + 3 * int(position / (ROAD_M / CELLS))
            state[place + (0 if traffic.slot[row] >= 0 else 1)] += 0.1
            state[place + 2] += speed
            continue
        inside = position < ROAD_M + crossing.link_length[link]
        place = base + 3 * CELLS + (0 if inside else 2)
        state[place] += 0.1
        state[place + 1] += speed
    for approach in range(4):
        base = approach * width
        for cell in range(CELLS):
            place = base + 3 * cell
            vehicles = 10.0 * (state[place] + state[place + 1])
            state[place + 2] /= max(vehicles, 1.0) * SPEED_LIMIT
        for place in (base + 3 * CELLS, base + 3 * CELLS + 2):
            state[place + 1] /= max(10.0 * state[place], 1.0) * SPEED_LIMIT
    state[4 * width] = happened.passed
    state[4 * width + 1] = min(happened.pending / 50.0, 5.0)


@compiled
def _late(traffic: Traffic, row: int) -> float:
    """Time headway under 1 s of an AV that drives behind somebody, as what is missing; at most 0."""
    speed = traffic.speed[row]
    if traffic.around[row, 0] < 0 or speed <= 0.0:
        return 0.0
    missing: float = min(max((traffic.around[row, 1] + MIN_GAP_M) / speed, 0.0) - 1.0, 0.0)
    return missing


@compiled
def _own(crossing: Crossing, speed: float, late: float) -> float:
    """What one AV earns by how it drives: the weighted scaled terms of speed, standstill and headway
    (`_late`), as if it were all that drives."""
    weights = crossing.weights
    nearness = max(1.0 - abs(speed - TARGET_SPEED) / TARGET_SPEED, 0.0)
    quickness = min(speed / SPEED_LIMIT, 1.0)
    standing = 1.0 if speed < 0.1 else 0.0
    paid: float = weights[0] * nearness - weights[1] * standing + (weights[2] + weights[3]) * quickness
    paid += weights[6] * late
    return paid


@compiled
def _pay(crossing: Crossing, traffic: Traffic, count: int, happened: Happened, seen: Seen) -> None:
    """Terms of the reward; the paper's are equations 7 to 12 of its appendix, with the gains it lists. By
    its equation 4 it pays 0.2 x the sum of the first six + the velocity's + 0.5 x the headway's."""
    automated, standing, stopped = 0, 0, 0
    squares, speeds, automated_speeds, headways = 0.0, 0.0, 0.0, 0.0
    for row in range(count):
        speed = traffic.speed[row]
        squares += (speed - TARGET_SPEED) ** 2
        speeds += speed
        stopped += speed == 0.0
        standing += speed < 0.1
        if traffic.slot[row] >= 0:
            automated += 1
            automated_speeds += speed
            late = _late(traffic, row)
            headways += late
            seen.own[traffic.slot[row]] = _own(crossing, speed, late)
    aim = TARGET_SPEED * np.sqrt(count)
    nearness = max(aim - np.sqrt(squares), 0.0) / (aim + _EPSILON) if count else 0.0
    fullest = STEP_S * count
    cost = STEP_S * (count - speeds / SPEED_LIMIT)
    quickness = max((fullest - cost) / (fullest + _EPSILON), 0.0)
    paper, scaled = seen.paper, seen.scaled
    paper[0] = 0.0 if happened.crashes else nearness
    paper[1] = -stopped
    paper[2] = automated_speeds
    paper[3] = quickness
    paper[4] = -happened.lane_changes
    paper[5] = happened.outflow_vph
    paper[6] = headways
    paper[7] = 0.0
    for term in range(8):
        paper[term] *= _PAPER_GAINS[term]
    scaled[0] = nearness
    scaled[1] = -standing / max(count, 1)
    scaled[2] = min(automated_speeds / max(automated, 1) / SPEED_LIMIT, 1.0)
    scaled[3] = min(quickness, 1.0)
    scaled[4] = -min(happened.lane_changes / max(automated, 1), 1.0)
    scaled[5] = min(happened.arrived, 1)
    scaled[6] = headways / max(automated, 1)
    scaled[7] = -min(happened.crashes, 1)
    combined, total = 0.0, 0.0
    for term in range(8):
        total += crossing.weights[term] * scaled[term]
        combined += paper[term] if term < 6 else 0.0
    seen.rewards[0] = total
    seen.rewards[1] = 0.2 * combined + paper[0] + 0.5 * paper[6]


@compiled
def _add_up(traffic: Traffic, count: int, seen: Seen) -> None:
    """Means over the vehicles of this step, in the order of SUMS."""
    sums = seen.sums
    automated, standing, fuel = 0, 0, 0.0
    speed_av, speed_hdv, change_av, change_hdv = 0.0, 0.0, 0.0, 0.0
    for row in range(count):
        speed = traffic.speed[row]
        change = (speed - traffic.before[row]) / STEP_S
        fuel += traffic.fuel[row]
        standing += speed < 0.1
        if traffic.slot[row] >= 0:
            automated += 1
            speed_av += speed
            change_av += abs(change)
            sums[9] = max(sums[9], -change)
            seen.present[traffic.link[row] // 4] += 1.0
        else:
            speed_hdv += speed
            change_hdv += abs(change)
            sums[10] = max(sums[10], -change)
    human = count - automated
    sums[3] += count
    if count:
        sums[0] += 1
        sums[4] += (speed_av + speed_hdv) / count
        sums[11] += fuel / count
        sums[12] += standing / count
    if automated:
        sums[1] += 1
        sums[5] += speed_av / automated
        sums[7] += change_av / automated
    if human:
        sums[2] += 1
        sums[6] += speed_hdv / human
        sums[8] += change_hdv / human


@compiled
def look(crossing: Crossing, traffic: Traffic, count: int, seen: Seen) -> None:
    """Observations of all AVs among V vehicles; rows of empty slots are 0."""
    seen.observations[:] = 0.0
    seen.alive[:] = False
    for row in range(count):
        slot = traffic.slot[row]
        if slot < 0:
            continue
        seen.alive[slot] = True
        _observe_paper(crossing, traffic, row, seen.observations[slot])
        if crossing.extended:
            _observe_extended(crossing, traffic, count, row, seen, seen.observations[slot])


def take_in(crossing: Crossing, traffic: Traffic, count: int, happened: Happened, seen: Seen) -> None:
    """All that follows from a step."""
    # One by one: handing records over takes longer than all that is done with them.
    _take_in(count, *crossing, *traffic, *happened, *seen)


@compiled_apart
def _take_in(count: int, *parts: Any) -> None:  # noqa: ANN401 - of the records, in order
    crossing, traffic = Crossing(*parts[:_TRAFFIC]), Traffic(*parts[_TRAFFIC:_HAPPENED])
    happened, seen = Happened(*parts[_HAPPENED:_SEEN]), Seen(*parts[_SEEN:])
    look(crossing, traffic, count, seen)
    _describe(crossing, traffic, count, happened, seen)
    _pay(crossing, traffic, count, happened, seen)
    _add_up(traffic, count, seen)


@compiled_apart
def read_in(
    answers: Floats,
    offset: Floats,
    automated: Whole,
    count: int,
    position: Floats,
    speed: Floats,
    before: Floats,
    fuel: Floats,
    around: Floats,
) -> None:
    """Fill the columns of `Traffic` with what SUMO answered: of each of V vehicles its speed, then of each
    the distance it has been driven, to which its `offset` (V,) is added, then of each its fuel; then what
    is `around` each row (M,) of an automated vehicle."""
    for row in range(count):
        before[row] = speed[row]
        speed[row] = answers[row]
        position[row] = answers[count + row] + offset[row]
        fuel[row] = answers[2 * count + row]
    place = 3 * count
    for row in automated:
        for column in range(4):
            around[row, column] = answers[place + column]
        place += 4


@compiled_apart
def wish(
    accelerations: NDArray[np.float32], slots: Whole, rows: Whole, speed: Floats, wished: Floats
) -> None:
    """Speeds (M,) that accelerations (N,) ask for, cut at STRONGEST, of AVs in these slots (M,) and rows of
    the vehicles' speeds (M,). Backwards nobody drives."""
    for i in range(len(slots)):
        acceleration = accelerations[slots[i]]
        if acceleration > STRONGEST:
            acceleration = np.float32(STRONGEST)
        elif acceleration < -STRONGEST:
            acceleration = np.float32(-STRONGEST)
        wished[i] = speed[rows[i]] + acceleration * np.float32(STEP_S)
        if wished[i] < 0.0:
            wished[i] = 0.0


def empty_traffic(rows: int) -> Traffic:
    """Room for so many vehicles."""
    position, speed, before, fuel = (np.zeros(rows) for _ in range(4))
    link, slot = (np.full(rows, -1, np.int64) for _ in range(2))
    return Traffic(position, speed, before, fuel, link, slot, np.full((rows, 4), -1.0))


def empty_seen(slots: int, extended: bool) -> Seen:
    """Room for so many slots."""
    return Seen(
        observations=np.zeros((slots, EXTENDED_SIZE if extended else PAPER_SIZE), np.float32),
        alive=np.zeros(slots, np.bool_),
        state=np.zeros(STATE_SIZE, np.float32),
        scaled=np.zeros(len(TERMS)),
        paper=np.zeros(len(TERMS)),
        rewards=np.zeros(2),
        own=np.zeros(slots),
        sums=np.zeros(len(SUMS)),
        present=np.zeros(4),
        first=np.zeros(LANES, np.int64),
        soonest=np.zeros(NEIGHBOURS),
        ranked=np.zeros(NEIGHBOURS, np.int64),
    )


def nothing_happened(passed: float = 0.0) -> Happened:
    """A step without events."""
    return Happened(0, 0, 0, 0.0, 0, passed)


def warm() -> None:
    """Compile, or load from the cache, by a step of an empty crossing."""
    none = np.zeros((16, 16), np.bool_)
    crossing = Crossing(np.ones(16), none, none, np.ones(len(TERMS)), 1600.0, True)
    traffic, seen, nobody = empty_traffic(1), empty_seen(1, True), np.zeros(0, np.int64)
    take_in(crossing, traffic, 0, nothing_happened(), seen)
    wish(np.zeros(1, np.float32), nobody, nobody, traffic.speed, np.zeros(0))
    read_in(
        np.zeros(0), np.zeros(1), nobody, 0,
        traffic.position, traffic.speed, traffic.before, traffic.fuel, traffic.around,
    )  # fmt: skip

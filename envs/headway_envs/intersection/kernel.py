"""What follows from where all vehicles are: observations, reward terms and sums for the metrics; compiled.

Axes: those of `layout`.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway_envs.intersection.config import STEP_S
from headway_envs.intersection.demand import MIN_GAP_M
from headway_envs.intersection.layout import (
    ACCOUNT,
    CELLS,
    CROSSING,
    LANES,
    NEAR_SIZE,
    NEIGHBOUR_SIZE,
    PAPER_SIZE,
    PAY_OWN,
    PAY_PAPER,
    PAY_TEAM,
    SCRATCH,
    TRAFFIC,
    WAY_SIZE,
    Floats,
    Record,
    Slots,
    StepEvents,
    Traffic,
    Whole,
)
from headway_envs.intersection.network import ROAD_M, SPEED_LIMIT
from headway_envs.numba_setup import compiled, compiled_apart, drop_stale_cache

drop_stale_cache(Path(__file__).parent)  # constants of other files are compiled in, too

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


@compiled
def _until_line(traffic: Traffic, row: int) -> float:
    """Time to the stop line at the speed of now, s, cut; 0 for who has passed it."""
    distance = max(ROAD_M - traffic.position[row], 0.0)
    seconds: float = distance / max(traffic.speed[row], 0.1)
    return min(seconds, _LONGEST_S)


@compiled
def _observe_paper(crossing: Record, traffic: Traffic, row: int, out: NDArray[np.float32]) -> None:
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
    crossing: Record, traffic: Traffic, row: int, scratch: Record, out: NDArray[np.float32]
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
        _show_crossing(crossing, traffic, row, scratch, out[near + NEAR_SIZE :])


@compiled
def _find_next(crossing: Record, traffic: Traffic, count: int, scratch: Record) -> None:
    """Who can come next on a way: the first on each link before the stop line, all inside the junction."""
    first, inside, found = scratch.first, scratch.inside, 0
    first[:] = -1
    for row in range(count):
        link = traffic.link[row]
        left = ROAD_M - traffic.position[row]
        if left > 0.0:
            if first[link] < 0 or left < ROAD_M - traffic.position[first[link]]:
                first[link] = row
        elif left > -crossing.link_length[link]:
            inside[found] = row
            found += 1
    inside[found] = -1


@compiled
def _head(crossing: Record, traffic: Traffic, link: int, lane: int, first: Whole) -> int:
    """The row of the first on a lane among those whose ways cross a link; -1: none."""
    head, least = -1, np.inf
    for way in range(2 * lane, 2 * lane + 2):
        row = int(first[way])
        if row < 0 or not crossing.foes[link, way]:
            continue
        left = ROAD_M - traffic.position[row]
        if left < least or (left == least and row < head):
            head, least = row, left
    return head


@compiled
def _show_crossing(
    crossing: Record, traffic: Traffic, row: int, scratch: Record, out: NDArray[np.float32]
) -> None:
    """Of all whose ways cross the own, those inside the junction and the first on each lane, four at most,
    the soonest first: 1, distance to their stop line (negative past it), speed, how much later they arrive,
    whether automated, whether they go first."""
    link = traffic.link[row]
    soonest, rows = scratch.soonest, scratch.ranked
    soonest[:] = np.inf
    rows[:] = -1
    for other in scratch.inside:
        if other < 0:
            break
        if crossing.foes[link, traffic.link[other]]:
            left = ROAD_M - traffic.position[other]
            _insert(soonest, rows, left / max(traffic.speed[other], _LIKELY_SPEED), int(other))
    for lane in range(LANES):
        head = _head(crossing, traffic, link, lane, scratch.first)
        if head >= 0:
            left = ROAD_M - traffic.position[head]
            _insert(soonest, rows, left / max(traffic.speed[head], _LIKELY_SPEED), head)
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
def _describe(crossing: Record, traffic: Traffic, count: int, happened: StepEvents, account: Record) -> None:
    """The state: for each approach, AVs, HDVs and mean speed in each cell of the road, then vehicles inside
    the junction and beyond it with their mean speeds; the share of the episode passed, vehicles waiting."""
    state = account.state
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
def _own(crossing: Record, traffic: Traffic, row: int) -> float:
    """What one AV earns by how it drives: the weighted scaled terms of speed, standstill and headway
    (`_late`), as if it were all that drives."""
    weights, speed = crossing.weights, traffic.speed[row]
    nearness = max(1.0 - abs(speed - TARGET_SPEED) / TARGET_SPEED, 0.0)
    quickness = min(speed / SPEED_LIMIT, 1.0)
    standing = 1.0 if speed < 0.1 else 0.0
    paid: float = weights[0] * nearness - weights[1] * standing + (weights[2] + weights[3]) * quickness
    paid += weights[6] * _late(traffic, row)
    return paid


@compiled
def _judge(
    crossing: Record, traffic: Traffic, count: int, happened: StepEvents, account: Record
) -> tuple[float, float]:
    """Terms of the reward, and what they come to: (scaled, the paper's). The paper's terms are equations 7
    to 12 of its appendix, with the gains it lists. By its equation 4 it pays 0.2 x the sum of the first six +
    the velocity's + 0.5 x the headway's."""
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
            headways += _late(traffic, row)
    aim = TARGET_SPEED * np.sqrt(count)
    nearness = max(aim - np.sqrt(squares), 0.0) / (aim + _EPSILON) if count else 0.0
    fullest = STEP_S * count
    cost = STEP_S * (count - speeds / SPEED_LIMIT)
    quickness = max((fullest - cost) / (fullest + _EPSILON), 0.0)
    paper, scaled = account.paper, account.scaled
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
    return total, 0.2 * combined + paper[0] + 0.5 * paper[6]


@compiled
def _pay(
    crossing: Record,
    traffic: Traffic,
    count: int,
    account: Record,
    slots: Slots,
    scaled_reward: float,
    paper_reward: float,
) -> None:
    """Pay for a step. The paper pays whoever was asked and still is on the road; so do own rewards, and the
    team's all slots."""
    rewards, paid = slots.rewards, 0
    for row in range(count):
        slot = traffic.slot[row]
        # Slots that were left since actions were asked for are empty still.
        if slot < 0 or not slots.acting[slot]:
            continue
        paid += 1
        if crossing.pays == PAY_PAPER:
            rewards[slot] += np.float32(paper_reward)
        elif crossing.pays == PAY_OWN:
            rewards[slot] += np.float32(_own(crossing, traffic, row))
    if crossing.pays == PAY_TEAM:
        for slot in range(len(rewards)):
            rewards[slot] += np.float32(scaled_reward)
    published = crossing.pays == PAY_PAPER
    account.paper_return += paper_reward * paid
    account.team_return += paper_reward if published else scaled_reward
    terms = account.paper if published else account.scaled
    for term in range(len(terms)):
        account.terms[term] += terms[term]


@compiled
def _add_up(traffic: Traffic, count: int, account: Record) -> None:
    """Means over the vehicles of this step."""
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
            account.hardest_braking_av = max(account.hardest_braking_av, -change)
            account.present[traffic.link[row] // 4] += 1.0
        else:
            speed_hdv += speed
            change_hdv += abs(change)
            account.hardest_braking_hdv = max(account.hardest_braking_hdv, -change)
    human = count - automated
    account.vehicles += count
    if count:
        account.steps_all += 1
        account.speed += (speed_av + speed_hdv) / count
        account.fuel += fuel / count
        account.standing += standing / count
    if automated:
        account.steps_av += 1
        account.speed_av += speed_av / automated
        account.acceleration_av += change_av / automated
    if human:
        account.steps_hdv += 1
        account.speed_hdv += speed_hdv / human
        account.acceleration_hdv += change_hdv / human


@compiled
def _look(crossing: Record, traffic: Traffic, count: int, scratch: Record, slots: Slots) -> None:
    """Observations of all AVs among V vehicles."""
    for slot in range(len(slots.alive)):
        if slots.alive[slot]:
            slots.observations[slot] = 0.0
            slots.alive[slot] = False
    if crossing.extended:
        _find_next(crossing, traffic, count, scratch)
    for row in range(count):
        slot = traffic.slot[row]
        if slot < 0:
            continue
        slots.alive[slot] = True
        _observe_paper(crossing, traffic, row, slots.observations[slot])
        if crossing.extended:
            _observe_extended(crossing, traffic, row, scratch, slots.observations[slot])


@compiled
def _read_in(traffic: Traffic, count: int, answers: Floats) -> None:
    """Fill the columns of `Traffic` with what SUMO answered."""
    place = 3 * count
    for row in range(count):
        traffic.before[row] = traffic.speed[row]
        traffic.speed[row] = answers[row]
        traffic.position[row] = answers[count + row] + traffic.offset[row]
        traffic.fuel[row] = answers[2 * count + row]
        if traffic.slot[row] >= 0:
            for column in range(4):
                traffic.around[row, column] = answers[place + column]
            place += 4


@compiled_apart
def take_in(
    crossing_memory: NDArray[np.void],
    traffic_memory: NDArray[np.void],
    account_memory: NDArray[np.void],
    scratch_memory: NDArray[np.void],
    observations: NDArray[np.float32],
    alive: NDArray[np.bool_],
    acting: NDArray[np.bool_],
    rewards: NDArray[np.float32],
    count: int,
    answers: Floats,
    arrived: int,
    crashes: int,
    lane_changes: int,
    outflow_vph: float,
    pending: int,
    passed: float,
) -> None:
    """All that follows from a step of V = `count` vehicles: from memory (1,) of CROSSING, TRAFFIC, ACCOUNT
    and SCRATCH, the parts of `Slots` and, in the end, those of `StepEvents`, since handing tuples over takes
    longer than all that is done with them.

    `answers` are SUMO's: of each vehicle its speed, then of each the distance it has been driven, then of
    each its fuel; then of each AV its part of `Traffic.around`."""
    crossing, traffic, account = crossing_memory[0], traffic_memory[0], account_memory[0]
    slots = Slots(observations, alive, acting, rewards)
    happened = StepEvents(arrived, crashes, lane_changes, outflow_vph, pending, passed)
    _read_in(traffic, count, answers)
    _look(crossing, traffic, count, scratch_memory[0], slots)
    _describe(crossing, traffic, count, happened, account)
    scaled_reward, paper_reward = _judge(crossing, traffic, count, happened, account)
    _pay(crossing, traffic, count, account, slots, scaled_reward, paper_reward)
    _add_up(traffic, count, account)


@compiled_apart
def wish(
    accelerations: NDArray[np.float32],
    acting: NDArray[np.bool_],
    traffic_memory: NDArray[np.void],
    count: int,
    wished: Floats,
) -> None:
    """Speeds (M,) that accelerations (N,) ask for, cut at STRONGEST, of the AVs among V = `count` vehicles,
    in their order. Who is not `acting` (N,) drives on as it does; backwards nobody."""
    traffic, place = traffic_memory[0], 0
    for row in range(count):
        slot = traffic.slot[row]
        if slot < 0:
            continue
        acceleration = accelerations[slot] if acting[slot] else np.float32(0.0)
        if acceleration > STRONGEST:
            acceleration = np.float32(STRONGEST)
        elif acceleration < -STRONGEST:
            acceleration = np.float32(-STRONGEST)
        wished[place] = traffic.speed[row] + acceleration * np.float32(STEP_S)
        if wished[place] < 0.0:
            wished[place] = 0.0
        place += 1


def warm() -> None:
    """Compile, or load from the cache, by a step of an empty crossing."""
    crossing, traffic, account, scratch = (
        np.zeros(1, dtype) for dtype in (CROSSING, TRAFFIC, ACCOUNT, SCRATCH)
    )
    slots, nothing = Slots.empty(1, True), np.zeros(0)
    take_in(crossing, traffic, account, scratch, *slots, 0, nothing, 0, 0, 0, 0.0, 0, 0.0)
    wish(np.zeros(1, np.float32), slots.acting, traffic, 0, nothing)

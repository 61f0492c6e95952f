"""Compiled kernel: observations, state, reward terms and sums for the metrics, from all vehicles' positions.

Axes: those of `intersection.layout`.
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
    EXTENDED_SIZE,
    NEAR_SIZE,
    NEIGHBOUR_SIZE,
    NUM_LANES,
    PAPER_SIZE,
    PATH_SIZE,
    REWARD_OWN,
    REWARD_PAPER,
    REWARD_TEAM,
    SCRATCH,
    TRAFFIC,
    Floats,
    Record,
    Slots,
    StepEvents,
    Traffic,
    Whole,
)
from headway_envs.intersection.network import ROAD_M, SPEED_LIMIT
from headway_envs.numba_setup import compiled, compiled_apart, drop_stale_cache

drop_stale_cache(Path(__file__).parent)  # constants of other files are compiled in

MAX_ACCELERATION = 3.0
"""Bound on commanded accelerations, m/s^2."""
TARGET_SPEED = 20.0
"""Speed at which the velocity term is largest, m/s."""
_MAX_ARRIVAL_S = 20.0
"""Maximum time of arrival in observations, s."""
_NEAR_M = 50.0
"""Unit of distances relevant to braking, m. Divided by the network's length, as in the paper's observation,
ten metres would be close to 0."""
_MAX_HEADWAY_S = 5.0
_MIN_RANKING_SPEED = 3.0
"""Minimum speed assumed when vehicles are ranked by time of arrival, m/s."""
_PAPER_GAINS = (1.0, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 0.0)
_EPSILON = 1e-5


@compiled
def _time_to_line(traffic: Traffic, row: int) -> float:
    """Return the time to the stop line at the current speed, s, at most `_MAX_ARRIVAL_S`; 0 beyond the
    line."""
    distance = max(ROAD_M - traffic.position[row], 0.0)
    seconds: float = distance / max(traffic.speed[row], 0.1)
    return min(seconds, _MAX_ARRIVAL_S)


@compiled
def _observe_paper(crossing: Record, traffic: Traffic, row: int, out: NDArray[np.float32]) -> None:
    """Fill the paper's observation (section 5.2): position on the edge, speed, leader and follower.

    The fifth feature is divided by the speed limit, as in Flow; the paper prints the length. The path through
    the junction counts as one edge."""
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
    """Fill the additional features of an extended observation: part of the path (3), distance and time to the
    stop line, turn (3); near distances (4) of the stop line, the leader (distance and time headway) and the
    follower; then the next vehicles on conflicting paths (`_observe_conflicts`)."""
    link, position, speed = traffic.link[row], traffic.position[row], traffic.speed[row]
    part = 0 if position < ROAD_M else (1 if position < ROAD_M + crossing.link_length[link] else 2)
    out[PAPER_SIZE + part] = 1.0
    left = max(ROAD_M - position, 0.0)
    out[PAPER_SIZE + 3] = left / ROAD_M
    out[PAPER_SIZE + 4] = _time_to_line(traffic, row) / _MAX_ARRIVAL_S
    turn = link % 4
    out[PAPER_SIZE + 5 + (turn if turn < 2 else turn - 1)] = 1.0
    near, around = PAPER_SIZE + PATH_SIZE, traffic.around[row]
    out[near] = min(left / _NEAR_M, 1.0)
    # 1 means far away or absent.
    out[near + 1 : near + NEAR_SIZE] = 1.0
    if around[0] >= 0:
        gap = around[1] + MIN_GAP_M
        out[near + 1] = min(gap / _NEAR_M, 1.0)
        out[near + 2] = min(gap / max(speed, 0.1) / _MAX_HEADWAY_S, 1.0)
    if around[2] >= 0:
        out[near + 3] = min((around[3] + MIN_GAP_M) / _NEAR_M, 1.0)
    if part < 2:
        _observe_conflicts(crossing, traffic, row, scratch, out[near + NEAR_SIZE :])


@compiled
def _find_candidates(crossing: Record, traffic: Traffic, count: int, scratch: Record) -> None:
    """List the candidates for conflicts: the first vehicle before the stop line of each link, and all
    vehicles inside the junction."""
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
def _first_on_lane(crossing: Record, traffic: Traffic, link: int, lane: int, first: Whole) -> int:
    """Return the row of the first vehicle on a lane among those in conflict with a link; -1: none."""
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
def _observe_conflicts(
    crossing: Record, traffic: Traffic, row: int, scratch: Record, out: NDArray[np.float32]
) -> None:
    """Fill the features of up to four vehicles in conflict, inside the junction or first on their lane, in
    order of arrival: 1, distance to the stop line (negative beyond it), speed, time of arrival minus that of
    the observing vehicle, whether automated, whether the observing vehicle must yield."""
    link = traffic.link[row]
    arrival, rows = scratch.arrival, scratch.ranked
    arrival[:] = np.inf
    rows[:] = -1
    for other in scratch.inside:
        if other < 0:
            break
        if crossing.foes[link, traffic.link[other]]:
            # Ranked by time, because a fast vehicle farther away may arrive first.
            left = ROAD_M - traffic.position[other]
            _insert(arrival, rows, left / max(traffic.speed[other], _MIN_RANKING_SPEED), int(other))
    for lane in range(NUM_LANES):
        head = _first_on_lane(crossing, traffic, link, lane, scratch.first)
        if head >= 0:
            left = ROAD_M - traffic.position[head]
            _insert(arrival, rows, left / max(traffic.speed[head], _MIN_RANKING_SPEED), head)
    mine, place = _time_to_line(traffic, row), 0
    for shown in rows:
        if shown < 0:
            return
        out[place] = 1.0
        out[place + 1] = (ROAD_M - traffic.position[shown]) / _NEAR_M
        out[place + 2] = traffic.speed[shown] / SPEED_LIMIT
        out[place + 3] = (_time_to_line(traffic, int(shown)) - mine) / _MAX_ARRIVAL_S
        out[place + 4] = 1.0 if traffic.slot[shown] >= 0 else 0.0
        out[place + 5] = 1.0 if crossing.yields[link, traffic.link[shown]] else 0.0
        place += NEIGHBOUR_SIZE


@compiled
def _insert(keys: Floats, rows: Whole, key: float, row: int) -> None:
    """Insert a row into rows (n,), sorted by ascending keys (n,); the last entry is dropped."""
    place = len(keys) - 1
    if key >= keys[place]:
        return
    while place > 0 and keys[place - 1] > key:
        keys[place], rows[place] = keys[place - 1], rows[place - 1]
        place -= 1
    keys[place], rows[place] = key, row


@compiled
def _fill_state(crossing: Record, traffic: Traffic, count: int, events: StepEvents, account: Record) -> None:
    """Fill the state: per approach, numbers of AVs and HDVs and mean speed in each cell of the road, then
    numbers and mean speeds of vehicles inside and beyond the junction; elapsed share of the episode, vehicles
    waiting to enter."""
    state = account.state
    state[:] = 0.0
    # Counts are divided by 10, so that features are of the order of 1; mean speeds follow from them below.
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
    state[4 * width] = events.progress
    state[4 * width + 1] = min(events.pending / 50.0, 5.0)


@compiled
def _headway_shortfall(traffic: Traffic, row: int) -> float:
    """Return the time headway of an AV to its leader minus 1 s, at most 0; 0 without a leader."""
    speed = traffic.speed[row]
    if traffic.around[row, 0] < 0 or speed <= 0.0:
        return 0.0
    missing: float = min(max((traffic.around[row, 1] + MIN_GAP_M) / speed, 0.0) - 1.0, 0.0)
    return missing


@compiled
def _own_reward(crossing: Record, traffic: Traffic, row: int) -> float:
    """Return one AV's own reward: the weighted scaled terms of speed, standstill and headway
    (`_headway_shortfall`), computed for this vehicle alone."""
    weights, speed = crossing.weights, traffic.speed[row]
    nearness = max(1.0 - abs(speed - TARGET_SPEED) / TARGET_SPEED, 0.0)
    quickness = min(speed / SPEED_LIMIT, 1.0)
    standing = 1.0 if speed < 0.1 else 0.0
    paid: float = weights[0] * nearness - weights[1] * standing + (weights[2] + weights[3]) * quickness
    paid += weights[6] * _headway_shortfall(traffic, row)
    return paid


@compiled
def _evaluate_rewards(
    crossing: Record, traffic: Traffic, count: int, events: StepEvents, account: Record
) -> tuple[float, float]:
    """Fill the reward terms and return their sums: (scaled, paper).

    The paper's terms are equations 7 to 12 of its appendix, with the gains it lists; by its equation 4 the
    sum is 0.2 x the first six terms + the velocity term + 0.5 x the headway term."""
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
            headways += _headway_shortfall(traffic, row)
    # The norm of the deviations from the target speed, relative to that of standing vehicles.
    aim = TARGET_SPEED * np.sqrt(count)
    nearness = max(aim - np.sqrt(squares), 0.0) / (aim + _EPSILON) if count else 0.0
    fullest = STEP_S * count
    cost = STEP_S * (count - speeds / SPEED_LIMIT)
    quickness = max((fullest - cost) / (fullest + _EPSILON), 0.0)
    paper, scaled = account.paper, account.scaled
    paper[0] = 0.0 if events.crashes else nearness
    paper[1] = -stopped
    paper[2] = automated_speeds
    paper[3] = quickness
    paper[4] = -events.lane_changes
    paper[5] = events.outflow_vph
    paper[6] = headways
    paper[7] = 0.0
    for term in range(8):
        paper[term] *= _PAPER_GAINS[term]
    scaled[0] = nearness
    scaled[1] = -standing / max(count, 1)
    scaled[2] = min(automated_speeds / max(automated, 1) / SPEED_LIMIT, 1.0)
    scaled[3] = min(quickness, 1.0)
    scaled[4] = -min(events.lane_changes / max(automated, 1), 1.0)
    scaled[5] = min(events.arrived, 1)
    scaled[6] = headways / max(automated, 1)
    scaled[7] = -min(events.crashes, 1)
    combined, total = 0.0, 0.0
    for term in range(8):
        total += crossing.weights[term] * scaled[term]
        combined += paper[term] if term < 6 else 0.0
    return total, 0.2 * combined + paper[0] + 0.5 * paper[6]


@compiled
def _credit_rewards(
    crossing: Record,
    traffic: Traffic,
    count: int,
    account: Record,
    slots: Slots,
    scaled_reward: float,
    paper_reward: float,
) -> None:
    """Add a step's rewards. The paper's and own rewards go to acting AVs that are still on the road, the
    team's to all slots."""
    rewards, paid = slots.rewards, 0
    for row in range(count):
        slot = traffic.slot[row]
        # Slots freed since the action was chosen are still empty.
        if slot < 0 or not slots.acting[slot]:
            continue
        paid += 1
        if crossing.reward_kind == REWARD_PAPER:
            rewards[slot] += np.float32(paper_reward)
        elif crossing.reward_kind == REWARD_OWN:
            rewards[slot] += np.float32(_own_reward(crossing, traffic, row))
    if crossing.reward_kind == REWARD_TEAM:
        for slot in range(len(rewards)):
            rewards[slot] += np.float32(scaled_reward)
    published = crossing.reward_kind == REWARD_PAPER
    account.paper_return += paper_reward * paid
    account.team_return += paper_reward if published else scaled_reward
    terms = account.paper if published else account.scaled
    for term in range(len(terms)):
        account.terms[term] += terms[term]


@compiled
def _add_to_sums(traffic: Traffic, count: int, account: Record) -> None:
    """Add this step's means over vehicles to the sums of the episode."""
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
def _observe_all(crossing: Record, traffic: Traffic, count: int, scratch: Record, slots: Slots) -> None:
    """Fill the observations and the alive mask of all slots, from V vehicles."""
    for slot in range(len(slots.alive)):
        # Rows of other slots are 0 already.
        if slots.alive[slot]:
            slots.observations[slot] = 0.0
            slots.alive[slot] = False
    if crossing.extended:
        _find_candidates(crossing, traffic, count, scratch)
    for row in range(count):
        slot = traffic.slot[row]
        if slot < 0:
            continue
        slots.alive[slot] = True
        _observe_paper(crossing, traffic, row, slots.observations[slot])
        if crossing.extended:
            _observe_extended(crossing, traffic, row, scratch, slots.observations[slot])


@compiled
def _store_readings(traffic: Traffic, count: int, readings: Floats) -> None:
    """Copy SUMO's readings into the columns of `Traffic`."""
    place = 3 * count
    for row in range(count):
        traffic.before[row] = traffic.speed[row]
        traffic.speed[row] = readings[row]
        traffic.position[row] = readings[count + row] + traffic.offset[row]
        traffic.fuel[row] = readings[2 * count + row]
        if traffic.slot[row] >= 0:
            for column in range(4):
                traffic.around[row, column] = readings[place + column]
            place += 4


@compiled_apart
def process_step(
    crossing_records: NDArray[np.void],
    traffic_records: NDArray[np.void],
    account_records: NDArray[np.void],
    scratch_records: NDArray[np.void],
    observations: NDArray[np.float32],
    alive: NDArray[np.bool_],
    acting: NDArray[np.bool_],
    rewards: NDArray[np.float32],
    count: int,
    readings: Floats,
    arrived: int,
    crashes: int,
    lane_changes: int,
    outflow_vph: float,
    pending: int,
    progress: float,
) -> None:
    """Update observations, state, rewards and sums after a step of V = `count` vehicles.

    Arguments are records (1,) of CROSSING, TRAFFIC, ACCOUNT and SCRATCH, the fields of `Slots` and, at the
    end, those of `StepEvents`, because passing tuples costs more time than the computation. `readings`: speed
    of each vehicle, then distance driven of each, then fuel rate of each, then `Traffic.around` of each
    AV."""
    crossing, traffic, account = crossing_records[0], traffic_records[0], account_records[0]
    slots = Slots(observations, alive, acting, rewards)
    events = StepEvents(arrived, crashes, lane_changes, outflow_vph, pending, progress)
    _store_readings(traffic, count, readings)
    _observe_all(crossing, traffic, count, scratch_records[0], slots)
    _fill_state(crossing, traffic, count, events, account)
    scaled_reward, paper_reward = _evaluate_rewards(crossing, traffic, count, events, account)
    _credit_rewards(crossing, traffic, count, account, slots, scaled_reward, paper_reward)
    _add_to_sums(traffic, count, account)


@compiled_apart
def target_speeds(
    accelerations: NDArray[np.float32],
    acting: NDArray[np.bool_],
    traffic_records: NDArray[np.void],
    count: int,
    targets: Floats,
) -> None:
    """Fill `targets` with the speeds that follow from accelerations (N,), clipped to `MAX_ACCELERATION`, for
    the AVs among V = `count` vehicles in order of rows. AVs not `acting` (N,) keep their speed; speeds are at
    least 0."""
    traffic, place = traffic_records[0], 0
    for row in range(count):
        slot = traffic.slot[row]
        if slot < 0:
            continue
        acceleration = accelerations[slot] if acting[slot] else np.float32(0.0)
        if acceleration > MAX_ACCELERATION:
            acceleration = np.float32(MAX_ACCELERATION)
        elif acceleration < -MAX_ACCELERATION:
            acceleration = np.float32(-MAX_ACCELERATION)
        targets[place] = traffic.speed[row] + acceleration * np.float32(STEP_S)
        if targets[place] < 0.0:
            targets[place] = 0.0
        place += 1


def warm() -> None:
    """Compile every function, or load it from the cache, by a step of an empty road."""
    crossing, traffic, account, scratch = (
        np.zeros(1, dtype) for dtype in (CROSSING, TRAFFIC, ACCOUNT, SCRATCH)
    )
    slots, nothing = Slots.empty(1, EXTENDED_SIZE), np.zeros(0)
    process_step(crossing, traffic, account, scratch, *slots, 0, nothing, 0, 0, 0, 0.0, 0, 0.0)
    target_speeds(np.zeros(1, np.float32), slots.acting, traffic, 0, nothing)

"""Road with one or two ramp lanes.

The highway (y = 0) consists of the roads ab, bc and cd, divided at x = 320 and 420 m. A ramp lane consists of
the road jk (outer lane: mn), the sine-shaped kb (nb) from x = 220 m, and a lane of bc, which ends at an
obstacle. Source: the merging environment of Chen et al. 2022 (arXiv:2105.05701). The position of the outer
ramp lane is an assumption: parallel to the inner one, one lane width further out.
"""

import math

import numpy as np

from headway_envs.merge.kernel.layout import LANE, LANE_WIDTH, RAMP_END, Network

CONVERGES, PARALLEL, END = 220.0, 320.0, 520.0
AMPLITUDE = 3.25

Row = dict[str, float]


def build(ramp_lanes: int) -> Network:
    """Return the network with one or two ramp lanes."""
    names = ["ab", "bc0", *(f"bc{r}" for r in range(1, ramp_lanes + 1)), "cd", "jk", "kb"]
    names += ["mn", "nb"] if ramp_lanes == 2 else []
    at = {name: index for index, name in enumerate(names)}
    rows: dict[str, Row] = {
        "ab": _lane(0.0, PARALLEL, 0.0, successor=at["bc0"], left=at["ab"], right=at["kb"]),
        "bc0": _lane(PARALLEL, RAMP_END, 0.0, successor=at["cd"], left=at["bc0"], right=at["bc1"]),
        "cd": _lane(RAMP_END, END, 0.0, successor=at["cd"], left=at["cd"]),
    }
    rows["ab"]["beside_from"] = CONVERGES
    near = {"ab": ["ab", "bc0"], "bc0": ["ab", "bc0", "cd"], "cd": ["bc0", "cd"]}
    for ramp, (begin, sine) in enumerate((("jk", "kb"), ("mn", "nb"))[:ramp_lanes], start=1):
        end, outer = f"bc{ramp}", LANE_WIDTH * ramp
        beside = {"kb": "ab", "nb": "kb"}[sine]
        far = outer + 2.0 * AMPLITUDE
        rows[begin] = _lane(0.0, CONVERGES, far, successor=at[sine], right=at[begin], closed=1)
        rows[sine] = _lane(
            CONVERGES,
            PARALLEL,
            outer + AMPLITUDE,
            successor=at[end],
            left=at[beside],
            right=at[sine],
            closed=1,
        )
        length = PARALLEL - CONVERGES
        rows[sine].update(amplitude=AMPLITUDE, pulsation=math.pi / length, phase=math.pi / 2)
        # With two ramp lanes the inner one must be open to vehicles on the outer one.
        rows[end] = _lane(PARALLEL, RAMP_END, outer, left=at["bc0"] + ramp - 1, right=at[end], merging=1)
        rows[end].update(closed=int(ramp == ramp_lanes), successor=at["cd"])
        near.update({begin: [begin, sine], sine: [begin, sine, end], end: [sine, end]})
    for name, row in rows.items():
        road = [other for other in names if other[:2] == name[:2]]
        row.update(first=at[road[0]], last=at[road[-1]])
    lanes = np.zeros(len(names), LANE)
    reach = np.zeros((len(names), len(names)), np.bool_)
    for name, row in rows.items():
        for field, value in row.items():
            lanes[at[name]][field] = value
        reach[at[name], [at[other] for other in near[name]]] = True
    ramps = ["jk", "mn"][:ramp_lanes]
    return Network(
        lanes=lanes,
        near=reach,
        spawn=np.array([at["ab"], *(at[ramp] for ramp in ramps)]),
        obstacles=np.array([[RAMP_END, LANE_WIDTH * ramp] for ramp in range(1, ramp_lanes + 1)]),
    )


def _lane(begin: float, end: float, y: float, **fields: float) -> Row:
    return {
        "x": begin,
        "length": end - begin,
        "y": y,
        "left": -1,
        "right": -1,
        "beside_from": -math.inf,
    } | fields

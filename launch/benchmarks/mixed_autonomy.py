"""The crossing of Yan and Wu (2021, arXiv:2111.04686): controllers without learning beside their evaluations.

Published values are the means of the evaluations in the authors' repository
(github.com/ZhongxiaYan/mixed_autonomy_intersections), made with SUMO 1.1.0.
"""

from collections.abc import Mapping
from contextlib import closing

import numpy as np

from headway.registry import env_entry
from headway_envs.junctions.traffic import ACCELERATIONS

CONTROLLERS = ("signal", "signal_best", "max_pressure", "human")
PUBLISHED: Mapping[str, tuple[float | None, ...]] = {
    "400x850": (None, 2493.6, 2493.6, 1731.0),
    "400x1000": (2510.4, 2802.0, 2792.4, 1810.2),
    "550x850": (2800.8, None, 2797.2, 2035.2),
    "550x1000": (2814.0, 3108.0, 3006.0, 1879.8),
    "700x700": (None, 2796.0, 2803.2, 1544.4),
    "700x850": (3097.2, None, 3025.2, 1594.8),
    "700x1000": (3112.8, 3310.8, 3021.6, 1823.4),
    "850x550": (None, None, None, 2200.8),
    "850x850": (3307.2, 3343.2, 3003.6, 1869.6),
    "850x1000": (3301.2, 3333.6, 3001.2, 2232.6),
}
"""Outflow, veh/h, by demand, of `CONTROLLERS`. None: not published. Where the best greens are 25 s on both
roads, the two signals are one controller, and its value is published under one of their names."""


def outflow(
    controller: str, demand: str, seeds: int = 3, followed: float = 1.0, **arguments: float
) -> tuple[float, float]:
    """Return the outflow, veh/h, and the collided vehicles per episode, means over `seeds` episodes.

    `followed`: probability, per vehicle and step, that an automated vehicle follows the controller; otherwise
    it accelerates. `arguments`: other arguments of the environment.
    """
    entry = env_entry("junctions")
    prepared, rows = entry.prepare(entry.config(demand=demand, **arguments)), []
    with closing(entry.make(prepared, 1)) as env:
        for seed in range(1, seeds + 1):
            rule, ended = entry.rules[controller].make(prepared), False
            random = np.random.default_rng(seed)
            observed = env.reset(np.array([seed], np.uint64))
            while not ended:
                actions = rule.act(env, observed)
                actions[random.random(actions.shape) >= followed] = len(ACCELERATIONS) - 1
                outcome, observed = env.step(actions)
                ended = bool(outcome.episode_ended[0])
            rows.append(dict(zip(env.spec.metrics, outcome.metrics[0].tolist(), strict=True)))
    outflows, collided = ([row[name] for row in rows] for name in ("outflow_vph", "collided_vehicles"))
    return float(np.mean(outflows)), float(np.mean(collided))


def report() -> None:
    """Print the outflow of each controller at each demand beside the published one."""
    print("\n## Controllers without learning: outflow, veh/h, here / published (difference)\n")
    print(f"| horizontal x vertical, veh/h | {' | '.join(f'`{name}`' for name in CONTROLLERS)} |")
    print(f"|---|{'---:|' * len(CONTROLLERS)}")
    crashes = 0.0
    for demand, published in PUBLISHED.items():
        cells = []
        for controller, theirs in zip(CONTROLLERS, published, strict=True):
            if theirs is None:
                cells.append("")
                continue
            ours, collided = outflow(controller, demand)
            crashes += 3 * collided
            cells.append(f"{ours:,.0f} / {theirs:,.0f} ({100 * (ours / theirs - 1):+.1f}%)")
        print(f"| {demand} | {' | '.join(cells)} |", flush=True)
    print(f"\nThree episodes per cell; {crashes:.0f} collided vehicles in all.")
    _report_mixtures()


def _report_mixtures(demand: str = "700x700") -> None:
    """Print the outflow if automated vehicles follow `gap_acceptance` at a part of the steps only."""
    print(f"\n## The same crossing at {demand}, a third automated: `gap_acceptance` at a part of the steps\n")
    print("| probability per step | outflow, veh/h |\n|---:|---:|")
    for followed in (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0):
        found = outflow("gap_acceptance", demand, seeds=5, followed=followed, hdv_speed_mode=1)
        print(f"| {followed:g} | {found[0]:,.0f} |", flush=True)

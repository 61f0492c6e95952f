"""Grid search for the parameters of the literature's rules, a command of two CPU minutes:

    python -m tests.trials.bus_rule_parameters

Every combination plays the same days of the synthetic line, with holding times in seconds (`hold_levels=0`);
the one with the highest mean team reward is chosen, and `headway_envs.bus.entry` has it. The days have seeds
of their own: none of them is a day of an evaluation.
"""

from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np

from headway.contracts import child_seeds
from headway_envs.bus.config import BusConfig
from headway_envs.bus.env import BusBatchedEnv
from headway_envs.bus.metrics import METRICS
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.rules.holding import HoldingRule
from headway_envs.bus.rules.literature import (
    ForwardHeadway,
    SelfCoordinating,
    SimpleControl,
    TwoWayHeadway,
)

DAYS = 50
_SLACKS = (0.0, 10.0, 20.0, 30.0, 45.0, 60.0)
_GAINS = tuple(round(0.1 * tenth, 1) for tenth in range(1, 13))
GRIDS: Mapping[type[HoldingRule], Mapping[str, tuple[float, ...]]] = {
    ForwardHeadway: {"gain": _GAINS, "slack": _SLACKS},
    TwoWayHeadway: {"gain": _GAINS, "slack": _SLACKS},
    SimpleControl: {"kept": (0.0, *_GAINS[:9]), "slack": (*_SLACKS, 90.0, 120.0, 150.0, 180.0)},
    SelfCoordinating: {"gain": tuple(round(0.01 * percent, 2) for percent in range(1, 31))},
}
"""Values tried of each parameter."""


def candidates(prepared: Prepared, law: type[HoldingRule]) -> Iterator[tuple[dict[str, float], float]]:
    """Yield every combination of a law's parameters with its mean team reward per day."""
    grid = GRIDS[law]
    for values in product(*grid.values()):
        parameters = dict(zip(grid, values, strict=True))
        yield parameters, _mean_reward(prepared, law(prepared, **parameters))


def _mean_reward(prepared: Prepared, rule: HoldingRule) -> float:
    env = BusBatchedEnv(prepared, DAYS)
    observed = env.reset(child_seeds(0, "rule parameters", 0, DAYS))
    for _ in range(prepared.config.ticks):
        outcome, observed = env.step(rule.act(env, observed))
    return float(np.mean(outcome.metrics[:, METRICS.index("team_reward")]))


def main() -> None:
    """Print the five best combinations of each law."""
    prepared = prepare(BusConfig(control="holding", hold_levels=0))
    for law in GRIDS:
        ranked = sorted(candidates(prepared, law), key=lambda candidate: -candidate[1])
        print(law.__name__, *(f"{reward:.1f} {parameters}" for parameters, reward in ranked[:5]), sep="\n  ")


if __name__ == "__main__":
    main()

"""Registry entries of the toy environments."""

from collections.abc import Callable
from functools import partial
from typing import Any

from headway.contracts import RANDOM, EnvEntry, Lazy, Rule, RuleEntry
from headway_envs.toy.matrix import Matrix, MatrixConfig, OptimalMatrix
from headway_envs.toy.recall import OptimalRecall, Recall, RecallConfig
from headway_envs.toy.tracking import OptimalTracking, Tracking, TrackingConfig
from headway_envs.toy.trivial import OptimalTrivial, Trivial, TrivialConfig
from headway_envs.toy.visitors import OptimalVisitors, Visitors, VisitorsConfig

FROM_BATCHED = Lazy("headway_envs.parallel_env:from_batched")


def _rules(how: str, optimal: Callable[[Any], Rule]) -> dict[str, RuleEntry]:
    """Return the rules `random` and `optimal`, the latter with its one-line description."""
    return {"random": RANDOM, "optimal": RuleEntry(how, optimal)}


ENTRIES: dict[str, EnvEntry] = {
    "trivial": EnvEntry(
        summary="toy: ten agents name the largest of three numbers; measures the cost of everything else",
        config=TrivialConfig,
        make=Trivial,
        parallel_env=Lazy("headway_envs.toy.trivial_parallel:TrivialParallel"),
        rules=_rules("names the largest number at every step: returns `steps`", OptimalTrivial),
        metrics={"accuracy": "share of right actions, over steps and agents"},
    ),
    "matrix": EnvEntry(
        summary="toy: one-step matrix game of two agents with a trap beside the best payoff",
        config=MatrixConfig,
        make=Matrix,
        parallel_env=partial(FROM_BATCHED, Matrix),
        rules=_rules("both agents play their part of the largest payoff", OptimalMatrix),
        metrics={"optimal": "1 if the largest payoff was played, else 0"},
    ),
    "tracking": EnvEntry(
        summary="toy: agents with continuous actions follow a target; the optimum is in closed form",
        config=TrackingConfig,
        make=Tracking,
        parallel_env=partial(FROM_BATCHED, Tracking),
        rules=_rules(
            "finite-horizon linear-quadratic regulator (Bertsekas, vol. 1, section 3.1)", OptimalTracking
        ),
        metrics={
            "distance": "squared distance to the target, mean over steps and agents",
            "effort": "squared length of the clipped actions, mean over steps and agents",
        },
    ),
    "recall": EnvEntry(
        summary="toy: agents must name at the last step a cue shown at the first, which needs memory",
        config=RecallConfig,
        make=Recall,
        parallel_env=partial(FROM_BATCHED, Recall),
        rules=_rules("names the cue at every step, read from the environment: returns 1", OptimalRecall),
        metrics={"recalled": "share of agents that named their cue"},
    ),
    "visitors": EnvEntry(
        summary="toy: agents come, go and retire; action masks; NaN in rows of absent agents",
        config=VisitorsConfig,
        make=Visitors,
        parallel_env=partial(FROM_BATCHED, Visitors),
        rules=_rules("takes the best allowed option: regret 0", OptimalVisitors),
        metrics={
            "regret": "value of the best allowed option minus the reward, summed over all choices",
            "disallowed": "number of choices of an option that was not allowed",
            "choices": "number of choices, made by agents present and ready",
        },
    ),
}

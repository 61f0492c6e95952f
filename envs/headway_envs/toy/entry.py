"""The toy environments by name."""

from functools import partial

from headway.contracts import RANDOM, EnvEntry, Lazy, RuleEntry
from headway_envs.toy.matrix import Matrix, MatrixConfig, OptimalMatrix
from headway_envs.toy.recall import OptimalRecall, Recall, RecallConfig
from headway_envs.toy.tracking import OptimalTracking, Tracking, TrackingConfig
from headway_envs.toy.trivial import OptimalTrivial, Trivial, TrivialConfig
from headway_envs.toy.visitors import OptimalVisitors, Visitors, VisitorsConfig

FROM_BATCHED = Lazy("headway_envs.parallel_env:from_batched")


ENTRIES: dict[str, EnvEntry] = {
    "trivial": EnvEntry(
        summary="toy: ten agents name the largest of three numbers; measures everything around it",
        config=TrivialConfig,
        make=Trivial,
        parallel_env=Lazy("headway_envs.toy.trivial_parallel:TrivialParallel"),
        rules={
            "random": RANDOM,
            "optimal": RuleEntry("names the largest number at every step: returns `steps`", OptimalTrivial),
        },
        metrics={"accuracy": "share of right actions, over steps and agents"},
    ),
    "matrix": EnvEntry(
        summary="toy: one-step matrix game of two agents with a trap beside the best payoff",
        config=MatrixConfig,
        make=Matrix,
        parallel_env=partial(FROM_BATCHED, Matrix),
        rules={
            "random": RANDOM,
            "optimal": RuleEntry("both agents play their part of the largest payoff", OptimalMatrix),
        },
        metrics={"optimal": "1 where the largest payoff was played, else 0"},
    ),
    "tracking": EnvEntry(
        summary="toy: agents with continuous actions follow a target; the optimum is in closed form",
        config=TrackingConfig,
        make=Tracking,
        parallel_env=partial(FROM_BATCHED, Tracking),
        rules={
            "random": RANDOM,
            "optimal": RuleEntry(
                "the linear-quadratic regulator of the steps that are left (Bertsekas, vol. 1, section 3.1)",
                OptimalTracking,
            ),
        },
        metrics={
            "distance": "squared distance to the target, mean over steps and agents",
            "effort": "squared length of the actions as cut to their bounds, likewise",
        },
    ),
    "recall": EnvEntry(
        summary="toy: a cue seen at the first step is to be named at the last, which needs memory",
        config=RecallConfig,
        make=Recall,
        parallel_env=partial(FROM_BATCHED, Recall),
        rules={
            "random": RANDOM,
            "optimal": RuleEntry(
                "names the cue at every step, as the environment has it: returns 1",
                OptimalRecall,
            ),
        },
        metrics={"recalled": "share of agents that named their cue"},
    ),
    "visitors": EnvEntry(
        summary="toy: agents come, go and retire, with action masks and NaN in every absent row",
        config=VisitorsConfig,
        make=Visitors,
        parallel_env=partial(FROM_BATCHED, Visitors),
        rules={
            "random": RANDOM,
            "optimal": RuleEntry("takes the best allowed option: regret 0", OptimalVisitors),
        },
        metrics={
            "regret": "worth of the best allowed options less what was paid, summed over all choices",
            "disallowed": "choices of an option that was not allowed",
            "choices": "choices of agents that were there and ready",
        },
    ),
}

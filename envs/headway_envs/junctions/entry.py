"""Registry entry of the junctions."""

from functools import partial

from headway.contracts import RANDOM, EnvEntry, Lazy, RuleEntry
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.metrics import METRIC_DESCRIPTIONS

_RULES = "headway_envs.junctions.rules"

ENTRY = EnvEntry(
    summary="Automated vehicles at junctions without signals, in any SUMO network (SUMO)",
    config=JunctionsConfig,
    make=Lazy("headway_envs.junctions.env:JunctionsBatchedEnv"),
    prepare=Lazy("headway_envs.junctions.prepared:prepare"),
    digest=Lazy("headway_envs.junctions.files:digest"),
    parallel_env=Lazy("headway_envs.junctions.parallel:JunctionsSlotsParallelEnv"),
    rules={
        "human": RuleEntry(
            "SUMO drives all vehicles as humans, with all checks including right of way (speed mode 31)",
            partial(Lazy(f"{_RULES}:Humans"), right_of_way=True),
            internal=True,
        ),
        "human_mode1": RuleEntry(
            "SUMO drives all vehicles as humans that only keep a safe gap to the leader (speed mode 1)",
            partial(Lazy(f"{_RULES}:Humans"), right_of_way=False),
            internal=True,
        ),
        "signal": RuleEntry(
            "the network's traffic lights, with fixed times; right of way at junctions without one",
            Lazy(f"{_RULES}:FixedSignal"),
            internal=True,
        ),
        "signal_best": RuleEntry(
            "signal, with the greens that Yan and Wu (2021, arXiv:2111.04686) found best for their demands",
            partial(Lazy(f"{_RULES}:FixedSignal"), best=True),
            internal=True,
        ),
        "virtual_signal": RuleEntry(
            "signal_best that only automated vehicles observe (Ferreira et al. 2010)",
            Lazy(f"{_RULES}:VirtualSignal"),
        ),
        "gap_acceptance": RuleEntry(
            "automated vehicles let crossing platoons pass and go in the gap behind them",
            Lazy(f"{_RULES}:GapAcceptance"),
        ),
        "max_pressure": RuleEntry(
            "signal, with green every 12 s for the phase of maximum pressure (Varaiya 2013)",
            Lazy(f"{_RULES}:MaxPressure"),
            internal=True,
        ),
        "full_throttle": RuleEntry(
            "all automated vehicles accelerate at every step",
            partial(Lazy("headway_envs.constant_action:ConstantAction"), action=2),
        ),
        "random": RANDOM,
    },
    metrics=METRIC_DESCRIPTIONS,
    renderer=Lazy("headway_envs.junctions.renderer:JunctionsRenderer"),
    preload=("headway_envs.platoons", "headway_envs.junctions.env"),
)

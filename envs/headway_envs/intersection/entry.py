"""Registry entry of the intersection."""

from functools import partial

from headway.contracts import RANDOM, EnvEntry, Lazy, RuleEntry
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.metrics import METRIC_DESCRIPTIONS

SHARES = (0.25, 0.5, 0.75)
"""Shares of AVs that observe the signal, in the rules with partial compliance."""


ENTRY = EnvEntry(
    summary="Automated vehicles among human drivers at a crossing without signals (SUMO)",
    config=IntersectionConfig,
    make=Lazy("headway_envs.intersection.env:IntersectionBatchedEnv"),
    prepare=Lazy("headway_envs.intersection.prepared:prepare"),
    parallel_env=Lazy("headway_envs.intersection.parallel:IntersectionSlotsParallelEnv"),
    rules={
        "human": RuleEntry(
            "SUMO drives all vehicles as humans, with all checks including right of way (speed mode 31)",
            partial(Lazy("headway_envs.intersection.rules:Humans"), right_of_way=True),
            internal=True,
        ),
        "human_mode1": RuleEntry(
            "SUMO drives all vehicles as humans that only keep a safe gap to the leader (speed mode 1)",
            partial(Lazy("headway_envs.intersection.rules:Humans"), right_of_way=False),
            internal=True,
        ),
        "zero": RuleEntry(
            "commands an acceleration of 0 at every step",
            partial(Lazy("headway_envs.intersection.rules:Constant"), share=0.0),
        ),
        "full_throttle": RuleEntry(
            "commands the maximum acceleration at every step",
            partial(Lazy("headway_envs.intersection.rules:Constant"), share=1.0),
        ),
        "random": RANDOM,
        "reservation": RuleEntry(
            "first come, first served at the junction (after Dresner and Stone 2008, arXiv:1401.3466)",
            Lazy("headway_envs.intersection.rules:Reservation"),
        ),
        "virtual_signal": RuleEntry(
            "a signal that only AVs observe (Ferreira et al. 2010); meant for av_speed_mode=11",
            Lazy("headway_envs.intersection.rules:VirtualSignal"),
        ),
        **{
            f"virtual_signal_{share:g}": RuleEntry(
                f"virtual_signal observed by {share:.0%} of the AVs; the others drive as without it",
                partial(Lazy("headway_envs.intersection.rules:VirtualSignal"), share=share),
            )
            for share in SHARES
        },
    },
    metrics=METRIC_DESCRIPTIONS,
    renderer=Lazy("headway_envs.intersection.renderer:IntersectionRenderer"),
    preload=("headway_envs.platoons", "headway_envs.intersection.kernel", "headway_envs.intersection.env"),
    published=Lazy("headway_envs.intersection.published:INTERSECTION_PAPER"),
)

"""Registry entry of the intersection."""

from functools import partial

from headway.contracts import RANDOM, EnvEntry, Lazy, RuleEntry
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.metrics import MEANINGS

SHARES = (0.25, 0.5, 0.75)
"""Of AVs, in rules whose signal not all keep."""


ENTRY = EnvEntry(
    summary="Automated vehicles among human drivers at a crossing without signals (SUMO)",
    config=IntersectionConfig,
    make=Lazy("headway_envs.intersection.env:IntersectionBatchedEnv"),
    prepare=Lazy("headway_envs.intersection.prepared:prepare"),
    parallel_env=Lazy("headway_envs.intersection.parallel:IntersectionSlotsParallelEnv"),
    rules={
        "human": RuleEntry(
            "SUMO drives all as humans, with every check, right of way among them (speed mode 31)",
            partial(Lazy("headway_envs.intersection.rules:Humans"), right_of_way=True),
        ),
        "human_mode1": RuleEntry(
            "SUMO drives all as humans, who keep a safe gap to the leader and no more (speed mode 1)",
            partial(Lazy("headway_envs.intersection.rules:Humans"), right_of_way=False),
        ),
        "zero": RuleEntry(
            "asks for an acceleration of 0 always",
            partial(Lazy("headway_envs.intersection.rules:Constant"), share=0.0),
        ),
        "full_throttle": RuleEntry(
            "asks for the strongest acceleration always",
            partial(Lazy("headway_envs.intersection.rules:Constant"), share=1.0),
        ),
        "random": RANDOM,
        "reservation": RuleEntry(
            "first come, first served through the junction (after Dresner and Stone 2008, arXiv:1401.3466)",
            Lazy("headway_envs.intersection.rules:Reservation"),
        ),
        "virtual_signal": RuleEntry(
            "a signal AVs alone know and impose on those behind (Ferreira et al. 2010); for av_speed_mode=11",
            Lazy("headway_envs.intersection.rules:VirtualSignal"),
        ),
        **{
            f"virtual_signal_{share:g}": RuleEntry(
                f"virtual_signal kept by {share:.0%} of the AVs; the others drive as if there were none",
                partial(Lazy("headway_envs.intersection.rules:VirtualSignal"), share=share),
            )
            for share in SHARES
        },
    },
    metrics=MEANINGS,
    renderer=Lazy("headway_envs.intersection.renderer:IntersectionRenderer"),
    preload=("headway_envs.intersection.kernel", "headway_envs.intersection.env"),
    published=Lazy("headway_envs.intersection.published:INTERSECTION_PAPER"),
)

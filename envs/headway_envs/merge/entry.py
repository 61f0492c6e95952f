"""Registry entries of the merging environments."""

from functools import partial

from headway.contracts import RANDOM, EnvEntry, Lazy, RuleEntry
from headway_envs.merge.config import MergeConfig
from headway_envs.merge.metrics import MEANINGS

RULES: dict[str, RuleEntry] = {
    "idle": RuleEntry(
        "keeps the lane and the speed: whoever is on a ramp hits its end",
        Lazy("headway_envs.merge.rules:Idle"),
    ),
    "always_left": RuleEntry(
        "changes to the left as soon as that is allowed, whoever is there, and keeps the speed",
        Lazy("headway_envs.merge.rules:AlwaysLeft"),
    ),
    "idm_mobil": RuleEntry(
        "drives every CAV as a human driver: IDM, MOBIL, and its first speed as the desired one",
        Lazy("headway_envs.merge.rules:IdmMobil"),
    ),
    "random": RANDOM,
}


def _entry(summary: str, ramp_lanes: int, published: str) -> EnvEntry:
    return EnvEntry(
        summary=summary,
        config=MergeConfig,
        make=Lazy("headway_envs.merge.env:MergeBatchedEnv"),
        prepare=partial(Lazy("headway_envs.merge.prepared:prepare"), ramp_lanes=ramp_lanes),
        parallel_env=partial(Lazy("headway_envs.merge.parallel:parallel_env"), ramp_lanes=ramp_lanes),
        rules=RULES,
        metrics=MEANINGS,
        renderer=Lazy("headway_envs.merge.renderer:MergeRenderer"),
        preload=("headway_envs.merge.kernel", "headway_envs.merge.env"),
        published=Lazy(f"headway_envs.merge.published:{published}"),
    )


ENTRIES: dict[str, EnvEntry] = {
    "merge": _entry("CAVs among human drivers merge from a ramp lane into a highway", 1, "ONE_RAMP_LANE"),
    "merge_two_lane": _entry(
        "the same with two ramp lanes, of which the outer must change twice", 2, "TWO_RAMP_LANES"
    ),
}

"""Registry entries of the merging environments."""

from functools import partial

from headway.contracts import RANDOM, EnvEntry, Lazy, RuleEntry
from headway_envs.merge.config import MergeConfig
from headway_envs.merge.metrics import METRIC_DESCRIPTIONS

RULES: dict[str, RuleEntry] = {
    "idle": RuleEntry(
        "keeps lane and speed: CAVs on a ramp lane hit its end",
        partial(Lazy("headway_envs.constant_action:ConstantAction"), action=1),
    ),
    "always_left": RuleEntry(
        "changes to the left as soon as the mask allows it, and keeps the speed",
        Lazy("headway_envs.merge.rules:AlwaysLeft"),
    ),
    "idm_mobil": RuleEntry(
        "drives every CAV as a human driver: IDM, MOBIL, and its initial speed as the desired speed",
        Lazy("headway_envs.merge.rules:IdmMobil"),
        internal=True,
    ),
    "idm_mobil_actions": RuleEntry(
        "takes the action closest to IDM, one second ahead, and MOBIL; policies can start from it",
        Lazy("headway_envs.merge.rules:HumanActions"),
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
        lookahead="idm_mobil",
        metrics=METRIC_DESCRIPTIONS,
        renderer=Lazy("headway_envs.merge.renderer:MergeRenderer"),
        preload=("headway_envs.merge.kernel", "headway_envs.merge.env"),
        published=Lazy(f"headway_envs.merge.published:{published}"),
    )


ENTRIES: dict[str, EnvEntry] = {
    "merge": _entry("CAVs among human drivers merge from a ramp lane into a highway", 1, "ONE_RAMP_LANE"),
    "merge_two_lane": _entry(
        "CAVs among human drivers merge from two ramp lanes, the outer by two changes", 2, "TWO_RAMP_LANES"
    ),
}

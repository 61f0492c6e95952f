"""The merging environments' entries in the registry. Imports nothing heavy."""

from functools import partial
from typing import TYPE_CHECKING, Any

from headway.contracts import RANDOM, BatchedEnv, EnvEntry, Renderer, Rule, RuleEntry
from headway_envs.merge.config import MergeConfig
from headway_envs.merge.metrics import MEANINGS

if TYPE_CHECKING:
    from headway_envs.merge.prepared import Prepared


def _prepare(config: MergeConfig, ramp_lanes: int) -> "Prepared":
    from headway_envs.merge.prepared import prepare

    return prepare(config, ramp_lanes)


def _make(prepared: "Prepared", copies: int) -> BatchedEnv:
    from headway_envs.merge.env import MergeBatchedEnv

    return MergeBatchedEnv(prepared, copies)


def _parallel_env(config: "MergeConfig | Prepared", ramp_lanes: int) -> Any:  # noqa: ANN401 - EnvEntry's type
    from headway_envs.merge.env import MergeBatchedEnv
    from headway_envs.parallel_env import ParallelEnvBase

    prepared = _prepare(config, ramp_lanes) if isinstance(config, MergeConfig) else config
    return ParallelEnvBase(lambda copies: MergeBatchedEnv(prepared, copies))


def _renderer(prepared: "Prepared") -> Renderer:
    from headway_envs.merge.renderer import MergeRenderer

    return MergeRenderer(prepared)


def _idle(prepared: "Prepared") -> Rule:
    from headway_envs.merge.rules import Idle

    return Idle()


def _always_left(prepared: "Prepared") -> Rule:
    from headway_envs.merge.rules import AlwaysLeft

    return AlwaysLeft()


def _idm_mobil(prepared: "Prepared") -> Rule:
    from headway_envs.merge.rules import IdmMobil

    return IdmMobil()


RULES: dict[str, RuleEntry] = {
    "idle": RuleEntry("keeps the lane and the speed: whoever is on a ramp hits its end", _idle),
    "always_left": RuleEntry(
        "changes to the left as soon as that is allowed, whoever is there, and keeps the speed", _always_left
    ),
    "idm_mobil": RuleEntry(
        "drives every CAV as a human driver: IDM, MOBIL, and its first speed as the desired one", _idm_mobil
    ),
    "random": RANDOM,
}


def _entry(summary: str, ramp_lanes: int) -> EnvEntry:
    return EnvEntry(
        summary=summary,
        config=MergeConfig,
        make=_make,
        prepare=partial(_prepare, ramp_lanes=ramp_lanes),
        parallel_env=partial(_parallel_env, ramp_lanes=ramp_lanes),
        rules=RULES,
        metrics=MEANINGS,
        renderer=_renderer,
        preload=("headway_envs.merge.kernel", "headway_envs.merge.env"),
    )


ENTRIES: dict[str, EnvEntry] = {
    "merge": _entry("CAVs among human drivers merge from a ramp lane into a highway", 1),
    "merge_two_lane": _entry("the same with two ramp lanes, of which the outer must change twice", 2),
}

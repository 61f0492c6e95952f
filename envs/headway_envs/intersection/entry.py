"""The intersection's entry in the registry. Imports nothing heavy, and SUMO not at all."""

from functools import partial
from typing import TYPE_CHECKING, Any

from headway.contracts import RANDOM, BatchedEnv, EnvEntry, Renderer, Rule, RuleEntry
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.metrics import MEANINGS

if TYPE_CHECKING:
    from headway_envs.intersection.prepared import Prepared

SHARES = (0.25, 0.5, 0.75)
"""Of AVs, in rules whose signal not all keep."""


def _prepare(config: IntersectionConfig) -> "Prepared":
    from headway_envs.intersection.prepared import prepare

    return prepare(config)


def _make(prepared: "Prepared", copies: int) -> BatchedEnv:
    from headway_envs.intersection.env import IntersectionBatchedEnv

    return IntersectionBatchedEnv(prepared, copies)


def _parallel_env(config: Any) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    from headway_envs.intersection.parallel import IntersectionSlotsParallelEnv

    return IntersectionSlotsParallelEnv(config)


def _human(prepared: "Prepared") -> Rule:
    from headway_envs.intersection.rules import ALL_CHECKS, Humans

    return Humans(ALL_CHECKS)


def _human_mode1(prepared: "Prepared") -> Rule:
    from headway_envs.intersection.rules import SAFE_GAP_ONLY, Humans

    return Humans(SAFE_GAP_ONLY)


def _zero(prepared: "Prepared") -> Rule:
    from headway_envs.intersection.rules import Constant

    return Constant(0.0)


def _full_throttle(prepared: "Prepared") -> Rule:
    from headway_envs.intersection.kernel import STRONGEST
    from headway_envs.intersection.rules import Constant

    return Constant(STRONGEST)


def _reservation(prepared: "Prepared") -> Rule:
    from headway_envs.intersection.rules import Reservation

    return Reservation()


def _virtual_signal(prepared: "Prepared", share: float = 1.0) -> Rule:
    from headway_envs.intersection.rules import VirtualSignal

    return VirtualSignal(share)


def _renderer(prepared: "Prepared") -> Renderer:
    from headway_envs.intersection.renderer import IntersectionRenderer

    return IntersectionRenderer()


ENTRY = EnvEntry(
    summary="Automated vehicles among human drivers at a crossing without signals (SUMO)",
    config=IntersectionConfig,
    make=_make,
    prepare=_prepare,
    parallel_env=_parallel_env,
    rules={
        "human": RuleEntry(
            "SUMO drives all as humans, with every check, right of way among them (speed mode 31)", _human
        ),
        "human_mode1": RuleEntry(
            "SUMO drives all as humans, who keep a safe gap to the leader and no more (speed mode 1)",
            _human_mode1,
        ),
        "zero": RuleEntry("asks for an acceleration of 0 always", _zero),
        "full_throttle": RuleEntry("asks for the strongest acceleration always", _full_throttle),
        "random": RANDOM,
        "reservation": RuleEntry(
            "first come, first served through the junction (after Dresner and Stone 2008, arXiv:1401.3466)",
            _reservation,
        ),
        "virtual_signal": RuleEntry(
            "a signal AVs alone know and impose on those behind (Ferreira et al. 2010); for av_speed_mode=11",
            _virtual_signal,
        ),
        **{
            f"virtual_signal_{share:g}": RuleEntry(
                f"virtual_signal kept by {share:.0%} of the AVs; the others drive as if there were none",
                partial(_virtual_signal, share=share),
            )
            for share in SHARES
        },
    },
    metrics=MEANINGS,
    renderer=_renderer,
    preload=("headway_envs.intersection.kernel", "headway_envs.intersection.env"),
)

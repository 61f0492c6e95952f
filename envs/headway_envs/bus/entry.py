"""Registry entry of the bus environment. Imports no heavy module until one of its functions is called."""

from functools import partial
from typing import TYPE_CHECKING, Any

from headway.contracts import BatchedEnv, EnvEntry, Renderer, Rule, RuleEntry
from headway_envs.bus.config import BusConfig
from headway_envs.bus.metrics import MEANINGS

if TYPE_CHECKING:
    from headway_envs.bus.prepared import Prepared

HOLDING_SHARES = (0.7, 0.9)
"""Headways, as shares of the target, below which the headway_holding rules hold a bus."""


def _prepare(config: BusConfig) -> "Prepared":
    from headway_envs.bus.prepare import prepare

    return prepare(config)


def _prepare_beside(config: BusConfig, other: "Prepared") -> "Prepared":
    from headway_envs.bus.prepare import prepare_beside

    return prepare_beside(config, other)


def _make(prepared: "Prepared", copies: int) -> BatchedEnv:
    from headway_envs.bus.env import BusBatchedEnv

    return BusBatchedEnv(prepared, copies)


def _parallel_env(config: BusConfig) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    from headway_envs.bus.parallel import BusParallelEnv

    return BusParallelEnv(config)


def _renderer(prepared: "Prepared") -> Renderer:
    from headway_envs.bus.renderer import BusRenderer

    return BusRenderer(prepared)


def _always_move(prepared: "Prepared") -> Rule:
    from headway_envs.bus.rules import AlwaysMove

    return AlwaysMove()


def _move_with_service(prepared: "Prepared") -> Rule:
    from headway_envs.bus.rules import MoveWithService

    return MoveWithService()


def _headway_holding(prepared: "Prepared", share: float) -> Rule:
    from headway_envs.bus.rules import HeadwayHolding

    return HeadwayHolding(share, prepared.config.dispatch_window_s)


def _even_headway(prepared: "Prepared") -> Rule:
    from headway_envs.bus.rules import EvenHeadway

    return EvenHeadway()


def _schedule_holding(prepared: "Prepared") -> Rule:
    from headway_envs.bus.rules import ScheduleHolding

    return ScheduleHolding()


ENTRY = EnvEntry(
    summary="Buses that hold, move and go to service on lines with stochastic demand and travel times",
    config=BusConfig,
    make=_make,
    prepare=_prepare,
    prepare_beside=_prepare_beside,
    parallel_env=_parallel_env,
    rules={
        "always_move": RuleEntry(
            "leaves every stop and terminal at once, and never goes to the service centre", _always_move
        ),
        "move_with_service": RuleEntry(
            "as always_move, but goes to service in time, as the holding rules do", _move_with_service
        ),
        **{
            f"headway_holding_{share:g}": RuleEntry(
                f"holds while the headway is under {share:g} of the target (forward headway control); "
                "service in time",
                partial(_headway_holding, share=share),
            )
            for share in HOLDING_SHARES
        },
        "even_headway": RuleEntry(
            "holds while the bus ahead is nearer than the one behind and than the target; service in time",
            _even_headway,
        ),
        "schedule_holding": RuleEntry(
            "holds until the planned time, at stops and terminals; service in time", _schedule_holding
        ),
    },
    metrics=MEANINGS,
    renderer=_renderer,
    preload=("headway_envs.bus.kernel", "headway_envs.bus.env"),
)

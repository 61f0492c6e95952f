"""Registry entry of the bus environment."""

from functools import partial

from headway.contracts import EnvEntry, Lazy, RuleEntry
from headway_envs.bus.config import BusConfig
from headway_envs.bus.metrics import METRIC_DESCRIPTIONS

HOLDING_SHARES = (0.7, 0.9)
"""Headways, as shares of the target, below which the headway_holding rules hold a bus."""


ENTRY = EnvEntry(
    summary="Buses that hold, move and go to service on lines with stochastic demand and travel times",
    config=BusConfig,
    make=Lazy("headway_envs.bus.env:BusBatchedEnv"),
    prepare=Lazy("headway_envs.bus.prepare:prepare"),
    prepare_variant=Lazy("headway_envs.bus.prepare:prepare_variant"),
    parallel_env=Lazy("headway_envs.bus.parallel:BusParallelEnv"),
    rules={
        "always_move": RuleEntry(
            "leaves every stop and terminal at once, and never goes to the service centre",
            partial(Lazy("headway_envs.constant_action:ConstantAction"), action=1),
        ),
        "move_with_service": RuleEntry(
            "as always_move, but goes to service in time, as the holding rules do",
            Lazy("headway_envs.bus.rules:MoveWithService"),
        ),
        **{
            f"headway_holding_{share:g}": RuleEntry(
                f"holds while the headway is under {share:g} of the target (forward headway control); "
                "service in time",
                partial(Lazy("headway_envs.bus.rules:HeadwayHolding"), share=share),
            )
            for share in HOLDING_SHARES
        },
        "even_headway": RuleEntry(
            "holds while the bus ahead is nearer than the one behind and than the target; service in time",
            Lazy("headway_envs.bus.rules:EvenHeadway"),
        ),
        "schedule_holding": RuleEntry(
            "holds until the planned time, at stops and terminals; service in time",
            Lazy("headway_envs.bus.rules:ScheduleHolding"),
        ),
    },
    lookahead="even_headway",
    simulated=Lazy("headway_envs.bus.prepare:foreseeing_upkeep"),
    metrics=METRIC_DESCRIPTIONS,
    renderer=Lazy("headway_envs.bus.renderer:BusRenderer"),
    preload=("headway_envs.bus.kernel", "headway_envs.bus.env"),
)

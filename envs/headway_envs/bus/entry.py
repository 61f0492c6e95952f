"""Registry entry of the bus environment."""

from functools import partial

from headway.contracts import EnvEntry, Lazy, RuleEntry
from headway_envs.bus.config import BusConfig
from headway_envs.bus.metrics import METRIC_DESCRIPTIONS

HOLDING_SHARES = (0.7, 0.9)
"""Headways, as shares of the target, below which the headway_holding rules hold a bus."""

_LITERATURE = "headway_envs.bus.rules.literature:"
_LAWS = {
    "forward_headway": ("ForwardHeadway", "holds in proportion to the headway's shortfall (Daganzo 2009)"),
    "two_way_headway": (
        "TwoWayHeadway",
        "holds in proportion to the headways behind minus ahead (after Daganzo and Pilachowski 2011)",
    ),
    "simple_control": ("SimpleControl", "holds by delay and headway (Xuan, Argote and Daganzo 2011)"),
    "self_coordinating": (
        "SelfCoordinating",
        "holds for a share of the headway behind (Bartholdi and Eisenstein 2012)",
    ),
}
TUNED = {
    "forward_headway": {"gain": 0.2, "slack": 10.0},
    "two_way_headway": {"gain": 0.4, "slack": 30.0},
    "simple_control": {"kept": 0.5, "slack": 180.0},
    "self_coordinating": {"gain": 0.02},
}
"""Parameters of the literature's rules, chosen by `tests.trials.bus_rule_parameters` when breakdowns were
half as frequent. It now prefers a gain of 0.1 for `forward_headway` and a slack of 150 s for
`simple_control`."""

ENTRY = EnvEntry(
    summary="Buses that hold, move and go to service on lines with stochastic demand and travel times",
    config=BusConfig,
    make=Lazy("headway_envs.bus.env:BusBatchedEnv"),
    prepare=Lazy("headway_envs.bus.prepare:prepare"),
    prepare_variant=Lazy("headway_envs.bus.prepare:prepare_variant"),
    parallel_env=Lazy("headway_envs.bus.parallel:BusParallelEnv"),
    rules={
        "always_move": RuleEntry(
            "leaves every stop and terminal at once; never goes to the service centre unless control=holding",
            Lazy("headway_envs.bus.rules.holding:AlwaysMove"),
        ),
        "move_with_service": RuleEntry(
            "as always_move, but goes to service in time, as the holding rules do",
            Lazy("headway_envs.bus.rules.holding:MoveWithService"),
        ),
        **{
            f"headway_holding_{share:g}": RuleEntry(
                f"holds while the headway is under {share:g} of the target (forward headway control); "
                "service in time",
                partial(Lazy("headway_envs.bus.rules.holding:HeadwayHolding"), share=share),
            )
            for share in HOLDING_SHARES
        },
        "even_headway": RuleEntry(
            "holds while the bus ahead is nearer than the one behind and than the target; service in time",
            Lazy("headway_envs.bus.rules.holding:EvenHeadway"),
        ),
        "schedule_holding": RuleEntry(
            "holds until the planned time, at stops and terminals; service in time",
            Lazy("headway_envs.bus.rules.holding:ScheduleHolding"),
        ),
        **{
            name: RuleEntry(f"{summary}; service in time", partial(Lazy(_LITERATURE + law), **TUNED[name]))
            for name, (law, summary) in _LAWS.items()
        },
    },
    lookahead="even_headway",
    simulated=Lazy("headway_envs.bus.prepare:foreseeing_upkeep"),
    metrics=METRIC_DESCRIPTIONS,
    renderer=Lazy("headway_envs.bus.renderer:BusRenderer"),
    preload=("headway_envs.bus.kernel", "headway_envs.bus.env"),
)

"""Registry entry of the published bus environment."""

from functools import partial

from headway.contracts import RANDOM, EnvEntry, Lazy, RuleEntry
from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.metrics import METRIC_DESCRIPTIONS

SERVICE_BELOW = 0.5
"""Share of its uptime below which `move_with_service` sends a bus to the centre."""


ENTRY = EnvEntry(
    summary="Buses as in BusEnv's released code: fixed times, no simulated passengers, one clock per bus",
    config=BusPublishedConfig,
    make=Lazy("headway_envs.bus_published.env:BusPublishedBatchedEnv"),
    prepare=Lazy("headway_envs.bus_published.prepared:prepare"),
    parallel_env=Lazy("headway_envs.bus_published.parallel:parallel_env"),
    rules={
        "always_move": RuleEntry(
            "MOVE at every step, and never to the service centre",
            partial(Lazy("headway_envs.constant_action:ConstantAction"), action=1),
        ),
        "always_wait": RuleEntry(
            "WAIT at every step: no bus leaves its first stop",
            partial(Lazy("headway_envs.constant_action:ConstantAction"), action=0),
        ),
        "move_with_service": RuleEntry(
            f"MOVE, and to service once the uptime is below {SERVICE_BELOW:g} and the fuel lasts for the way",
            partial(Lazy("headway_envs.bus_published.rules:MoveWithService"), below=SERVICE_BELOW),
        ),
        "random": RANDOM,
    },
    lookahead="move_with_service",
    metrics=METRIC_DESCRIPTIONS,
    preload=("headway_envs.bus_published.kernel", "headway_envs.bus_published.env"),
    published=Lazy("headway_envs.bus_published.published:BUSENV_TABLE_3"),
)

"""The published bus environment's entry in the registry. Imports nothing heavy."""

from typing import TYPE_CHECKING, Any

from headway.contracts import RANDOM, BatchedEnv, EnvEntry, Rule, RuleEntry
from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.metrics import MEANINGS

if TYPE_CHECKING:
    from headway_envs.bus_published.prepared import Prepared

SERVICE_BELOW = 0.5
"""Share of its uptime below which `move_with_service` sends a bus to the centre."""


def _prepare(config: BusPublishedConfig) -> "Prepared":
    from headway_envs.bus_published.prepared import prepare

    return prepare(config)


def _make(prepared: "Prepared", copies: int) -> BatchedEnv:
    from headway_envs.bus_published.env import BusPublishedBatchedEnv

    return BusPublishedBatchedEnv(prepared, copies)


def _parallel_env(config: "BusPublishedConfig | Prepared") -> Any:  # noqa: ANN401 - EnvEntry's type
    from headway_envs.bus_published.env import BusPublishedBatchedEnv
    from headway_envs.parallel_env import ParallelEnvBase

    prepared = _prepare(config) if isinstance(config, BusPublishedConfig) else config
    scaled = prepared.config.observation == "scaled"
    return ParallelEnvBase(
        lambda copies: BusPublishedBatchedEnv(prepared, copies),
        name="headway_bus_published_v0",
        bound=1.0 if scaled else float("inf"),
        low=0.0,
    )


def _always(action: int) -> Rule:
    from headway_envs.bus_published.rules import Always

    return Always(action)


def _move_with_service(prepared: "Prepared") -> Rule:
    from headway_envs.bus_published.rules import MoveWithService

    return MoveWithService(SERVICE_BELOW)


ENTRY = EnvEntry(
    summary="Buses as in BusEnv's released code: fixed times, no passengers of their own, a clock each",
    config=BusPublishedConfig,
    make=_make,
    prepare=_prepare,
    parallel_env=_parallel_env,
    rules={
        "always_move": RuleEntry(
            "MOVE at every step, and never to the service centre", lambda prepared: _always(1)
        ),
        "always_wait": RuleEntry(
            "WAIT at every step: no bus leaves its first stop", lambda prepared: _always(0)
        ),
        "move_with_service": RuleEntry(
            f"MOVE, and to service once the uptime is below {SERVICE_BELOW:g} and the fuel lasts for the way",
            _move_with_service,
        ),
        "random": RANDOM,
    },
    metrics=MEANINGS,
    preload=("headway_envs.bus_published.kernel", "headway_envs.bus_published.env"),
)

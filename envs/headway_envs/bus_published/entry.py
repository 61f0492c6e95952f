"""The published bus environment's entry in the registry. Imports nothing heavy."""

from typing import TYPE_CHECKING, Any

from headway.contracts import BatchedEnv, EnvEntry, RandomRule, Rule
from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.meanings import MEANINGS

if TYPE_CHECKING:
    from headway_envs.bus_published.prepared import Prepared


def _prepare(config: BusPublishedConfig) -> "Prepared":
    from headway_envs.bus_published.prepared import prepare

    return prepare(config)


def _make(prepared: "Prepared", copies: int) -> BatchedEnv:
    from headway_envs.bus_published.env import BusPublishedBatchedEnv

    return BusPublishedBatchedEnv(prepared, copies)


def _parallel_env(config: "BusPublishedConfig | Prepared") -> Any:  # noqa: ANN401 - EnvEntry's type
    from headway_envs.bus_published.env import BusPublishedBatchedEnv
    from headway_envs.parallel_face import ParallelFace

    prepared = _prepare(config) if isinstance(config, BusPublishedConfig) else config
    scaled = prepared.config.observation == "scaled"
    return ParallelFace(
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

    return MoveWithService(0.5)


ENTRY = EnvEntry(
    summary="Buses as in BusEnv's released code: fixed times, no passengers of their own, a clock each",
    config=BusPublishedConfig,
    make=_make,
    prepare=_prepare,
    parallel_env=_parallel_env,
    rules={
        "always_move": lambda prepared: _always(1),
        "always_wait": lambda prepared: _always(0),
        "move_with_service": _move_with_service,
        "random": lambda prepared: RandomRule(),
    },
    metrics=MEANINGS,
    preload=("headway_envs.bus_published.kernel", "headway_envs.bus_published.env"),
)

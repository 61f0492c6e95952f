"""A PettingZoo ParallelEnv as a registry entry."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

from headway.adapters.pettingzoo import NO_OPTIONS, AdapterOptions, ParallelEnvBatch
from headway.contracts import RANDOM, BatchedEnv, EnvEntry, RuleEntry


def parallel_entry(
    name: str,
    summary: str,
    config: type,
    parallel_env: Callable[[Any], Any],
    options: AdapterOptions = NO_OPTIONS,
    rules: Mapping[str, RuleEntry] = MappingProxyType({}),
    metrics: Mapping[str, str] = MappingProxyType({}),
) -> EnvEntry:
    """Return the entry of an environment written as a ParallelEnv.

    `parallel_env` maps a config to a ParallelEnv. Workers unpickle it, so it must be a function at the top
    level of a module or a `Lazy`. `metrics`: description of each episode metric, as in `EnvEntry`; empty:
    those of `options` or of the environment's metadata, without descriptions.
    """
    options = replace(options, metrics=tuple(metrics) or options.metrics)
    return EnvEntry(
        summary=summary,
        config=config,
        make=partial(_make, parallel_env, options, name),
        parallel_env=parallel_env,
        rules={"random": RANDOM, **rules},
        metrics=metrics,
    )


def _make(
    parallel_env: Callable[[Any], Any],
    options: AdapterOptions,
    name: str,
    config: Any,  # noqa: ANN401 - the entry's record
    copies: int,
) -> BatchedEnv:
    return ParallelEnvBatch(lambda: parallel_env(config), copies, name, options)

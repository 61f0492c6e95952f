"""A PettingZoo ParallelEnv as a registry entry."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

from headway.adapters.pettingzoo import ParallelEnvBatch
from headway.contracts import RANDOM, BatchedEnv, EnvEntry, RuleEntry


@dataclass(frozen=True)
class AdapterOptions:
    """What PettingZoo has no place for; as `ParallelEnvBatch` takes it."""

    shared_reward: bool = False
    groups: tuple[str, ...] = ()
    agents_come_and_go: bool | None = None
    metrics: tuple[str, ...] | None = None
    max_copies_per_process: int | None = None

    def adapt(self, make_parallel_env: Callable[[], Any], copies: int, name: str) -> ParallelEnvBatch:
        """The batch of `copies` copies."""
        return ParallelEnvBatch(
            make_parallel_env,
            copies,
            name,
            shared_reward=self.shared_reward,
            groups=self.groups,
            agents_come_and_go=self.agents_come_and_go,
            metrics=self.metrics,
            max_copies_per_process=self.max_copies_per_process,
        )


NO_OPTIONS = AdapterOptions()


def parallel_entry(
    name: str,
    summary: str,
    config: type,
    parallel_env: Callable[[Any], Any],
    options: AdapterOptions = NO_OPTIONS,
    rules: Mapping[str, RuleEntry] = MappingProxyType({}),
) -> EnvEntry:
    """The entry of an environment that is written as a ParallelEnv; `parallel_env`: (config) -> ParallelEnv,
    a function at the top of a module, since workers are given it by name."""
    return EnvEntry(
        summary=summary,
        config=config,
        make=partial(_make, parallel_env, options, name),
        parallel_env=parallel_env,
        rules={"random": RANDOM, **rules},
    )


def _make(
    parallel_env: Callable[[Any], Any],
    options: AdapterOptions,
    name: str,
    config: Any,  # noqa: ANN401 - the entry's record
    copies: int,
) -> BatchedEnv:
    return options.adapt(lambda: parallel_env(config), copies, name)

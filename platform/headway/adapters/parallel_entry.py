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
    """Facts about an environment that PettingZoo has no place for: the arguments of `ParallelEnvBatch`."""

    shared_reward: bool | None = None
    """All agents get the same reward at every step; None: no, with a notice if rewards look shared."""
    groups: tuple[str, ...] = ()
    """Group of each agent; empty: all in one."""
    agents_come_and_go: bool | None = None
    """Agents may be absent before the episode ends; None: as stated by metadata and infos."""
    metrics: tuple[str, ...] | None = None
    """Names of the episode metrics; None: those in the environment's metadata."""
    max_copies_per_process: int | None = None
    """Maximum number of copies in one process; None: no limit."""

    def adapt(self, make_parallel_env: Callable[[], Any], copies: int, name: str) -> ParallelEnvBatch:
        """Return a batch of `copies` copies; `name` is used in messages."""
        return ParallelEnvBatch(
            make_parallel_env,
            copies,
            name,
            shared_reward=bool(self.shared_reward),
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
    """Return the entry of an environment written as a ParallelEnv.

    `parallel_env` maps a config to a ParallelEnv. Workers unpickle it, so it must be a function at the top
    level of a module or a `Lazy`.
    """
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

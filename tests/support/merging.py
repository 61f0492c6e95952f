"""Merging environments by name."""

from typing import Any

from played import begun

from headway_envs.merge.config import MergeConfig
from headway_envs.merge.entry import ENTRIES
from headway_envs.merge.env import MergeBatchedEnv


def make(name: str = "merge", copies: int = 1, **arguments: Any) -> MergeBatchedEnv:  # noqa: ANN401 - any argument
    """Return a batch after its reset, copy i with seed i."""
    entry = ENTRIES[name]
    env = entry.make(entry.prepare(MergeConfig(**arguments)), copies)
    assert isinstance(env, MergeBatchedEnv)
    return begun(env)

"""The published environment on the synthetic line, prepared once."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.bus_published.entry import ENTRY
from headway_envs.bus_published.env import BusPublishedBatchedEnv
from headway_envs.bus_published.prepared import Prepared, prepare

Begun = Callable[..., BusPublishedBatchedEnv]


@pytest.fixture(scope="session")
def line() -> Prepared:
    """Return the prepared data of five buses, each on one of the two patterns of the line."""
    return prepare(BusPublishedConfig(scenario="line"))


@pytest.fixture(scope="session")
def begun(line: Prepared) -> Begun:
    """(copies, changes of the configuration) -> batch after its reset, copy i with seed i."""

    def begin(copies: int = 1, **changes: Any) -> BusPublishedBatchedEnv:  # noqa: ANN401 - any argument
        config = BusPublishedConfig(scenario="line", **changes)
        env = ENTRY.make(Prepared(config, line.network, line.source), copies)
        assert isinstance(env, BusPublishedBatchedEnv)
        env.reset(np.arange(copies, dtype=np.uint64))
        return env

    return begin

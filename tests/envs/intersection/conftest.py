"""Intersections that are closed after each test, because a process holds one simulation."""

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import pytest

from headway_envs.intersection.config import IntersectionConfig

Open = Callable[..., Any]


@pytest.fixture(autouse=True)
def sumo() -> None:
    """Skip all tests without SUMO."""
    if find_spec("libsumo") is None:
        pytest.skip("SUMO (headway[sumo]) is not installed")


@pytest.fixture
def crossing() -> Iterator[Open]:
    """(arguments of the configuration) -> environment, closed after the test."""
    from headway_envs.intersection.env import IntersectionBatchedEnv
    from headway_envs.intersection.prepared import prepare

    opened = []

    def open_one(**arguments: Any) -> IntersectionBatchedEnv:  # noqa: ANN401 - any argument
        env = IntersectionBatchedEnv(prepare(IntersectionConfig(**arguments)), 1)
        opened.append(env)
        return env

    yield open_one
    for env in opened:
        env.close()

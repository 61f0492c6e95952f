"""The default bus scenario, prepared once."""

import pytest

from headway_envs.bus.config import BusConfig
from headway_envs.bus.prepare import prepare
from headway_envs.bus.prepared import Prepared


@pytest.fixture(scope="session")
def line() -> Prepared:
    """Return the prepared default scenario."""
    return prepare(BusConfig())

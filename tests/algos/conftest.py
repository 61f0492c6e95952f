"""One thread for torch, and random trajectories."""

from collections.abc import Callable

import made_trajectories
import pytest
import torch

from headway.contracts import Trajectory


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def fabricate() -> Callable[..., Trajectory]:
    return made_trajectories.fabricate

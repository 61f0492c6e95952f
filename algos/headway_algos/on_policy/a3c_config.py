"""Hyper-parameters of A3C. Importing them imports no torch."""

from dataclasses import dataclass
from typing import Literal

from headway_algos.config import AlgoConfig


@dataclass(frozen=True)
class A3CConfig(AlgoConfig):
    """Hyper-parameters of A3C: the order in which workers' gradients are applied."""

    application: Literal["arrival", "in_turns"] = "arrival"
    """When a worker's gradient is applied. `arrival`: as soon as it arrives, so that runs are not
    reproducible; `in_turns`: in a fixed order of workers, which is reproducible but makes fast workers wait
    (for tests). backend=serial always works in turns."""

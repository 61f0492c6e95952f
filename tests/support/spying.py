"""An environment that tells what its process has imported. Imports as little as an environment may."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from headway_envs.toy.trivial import Trivial, TrivialConfig


@dataclass(frozen=True)
class SpyConfig:
    """Where to tell it."""

    report: str
    trivial: TrivialConfig = field(default_factory=TrivialConfig)


def make_spy(config: SpyConfig, copies: int) -> Trivial:
    """`Trivial`, after writing the names of all modules."""
    Path(config.report).write_text("\n".join(sys.modules))
    return Trivial(config.trivial, copies)

"""An environment that reports the modules its process has imported. Has minimal imports itself."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from headway_envs.toy.trivial import Trivial, TrivialConfig


@dataclass(frozen=True)
class SpyConfig:
    """Configuration of the reporting environment."""

    report: str
    """Path of the file to write."""
    trivial: TrivialConfig = field(default_factory=TrivialConfig)


def make_spy(config: SpyConfig, copies: int) -> Trivial:
    """Write the names of all imported modules and return a `Trivial`."""
    Path(config.report).write_text("\n".join(sys.modules))
    return Trivial(config.trivial, copies)

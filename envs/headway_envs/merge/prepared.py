"""Data that all copies of a merging environment share. Imports numpy and the kernel's records only."""

from dataclasses import asdict, dataclass
from typing import Any

from numpy.typing import NDArray

from headway_envs.array_env import record
from headway_envs.merge.config import MergeConfig
from headway_envs.merge.kernel.layout import SETTINGS, Network
from headway_envs.merge.network import build


@dataclass(frozen=True)
class Prepared:
    """Road network and configuration; picklable."""

    config: MergeConfig
    ramp_lanes: int
    network: Network

    @property
    def name(self) -> str:
        """Registry name of the environment."""
        return "merge" if self.ramp_lanes == 1 else "merge_two_lane"

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the N slots."""
        return tuple(f"cav_{n}" for n in range(self.config.slots[0]))

    @property
    def vehicles(self) -> int:
        """Maximum number of CAVs and HDVs for which there is room."""
        return sum(self.config.slots)

    @property
    def settings(self) -> NDArray[Any]:
        """The configuration as one SETTINGS record, shape (1,)."""
        config, reward = self.config, self.config.reward
        values = asdict(config.dynamics)
        del values["masks"]
        values |= {
            "weight_collision": reward.collision,
            "weight_speed": reward.speed,
            "weight_ramp_end": reward.ramp_end,
            "weight_spacing": reward.spacing,
            "headway_s": reward.headway_s,
            "scope": ("global", "regional", "own").index(reward.scope),
            "min_cavs": config.cav_range[0],
            "max_cavs": config.cav_range[1],
            "min_hdvs": config.hdv_range[0],
            "max_hdvs": config.hdv_range[1],
            "steps": config.steps,
            "ramp_lanes": self.ramp_lanes,
            "supervisor": config.supervisor,
        }
        return record(SETTINGS, values)


def prepare(config: MergeConfig, ramp_lanes: int) -> Prepared:
    """Return the road with one or two ramp lanes and its configuration."""
    return Prepared(config, ramp_lanes, build(ramp_lanes))

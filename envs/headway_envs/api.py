"""Public interface of the environments: what packages, scripts and notebooks import from `headway_envs`.

`ENTRIES` names every environment; `ENTRIES["merge"].parallel_env(MergeConfig())` is a PettingZoo ParallelEnv.
`ArrayEnv` and `from_batched` help to write others; `write_sumo_scenario` writes an episode of the
intersection for SUMO; the remaining functions read, simulate and draw bus scenarios. Importing this module
imports no compiled kernel, no pandas and no SUMO. Every other module of the package is private.
"""

from typing import TYPE_CHECKING

from headway.contracts.lazy import lazy_attributes
from headway_envs.bus.config import BusConfig
from headway_envs.bus_published.config import BusPublishedConfig
from headway_envs.intersection.config import IntersectionConfig
from headway_envs.junctions.config import JunctionsConfig
from headway_envs.merge.config import MergeConfig
from headway_envs.registry import ENTRIES

if TYPE_CHECKING:
    from headway_envs.array_env import ArrayEnv
    from headway_envs.bus.prepare import prepare, prepare_replay
    from headway_envs.bus.realism.calls import simulated_days
    from headway_envs.bus.realism.comparison import call_km, compare_replay
    from headway_envs.bus.realism.plots import plot_headways_along, plot_load_profile, plot_time_space
    from headway_envs.bus.realism.trip_statistics import headway_statistics
    from headway_envs.bus.scenario.measures import link_loads
    from headway_envs.bus.scenario.plots import plot_scenario
    from headway_envs.bus.scenario.source import scenario_tables
    from headway_envs.intersection.sumo.scenario import write_sumo_scenario
    from headway_envs.parallel_env import ParallelEnvBase, from_batched

__all__ = [
    "ENTRIES",
    "ArrayEnv",
    "BusConfig",
    "BusPublishedConfig",
    "IntersectionConfig",
    "JunctionsConfig",
    "MergeConfig",
    "ParallelEnvBase",
    "call_km",
    "compare_replay",
    "from_batched",
    "headway_statistics",
    "link_loads",
    "plot_headways_along",
    "plot_load_profile",
    "plot_scenario",
    "plot_time_space",
    "prepare",
    "prepare_replay",
    "scenario_tables",
    "simulated_days",
    "write_sumo_scenario",
]
_REALISM, _SCENARIO = "headway_envs.bus.realism", "headway_envs.bus.scenario"
__getattr__ = lazy_attributes(
    __name__,
    {
        "ArrayEnv": "headway_envs.array_env:ArrayEnv",
        "ParallelEnvBase": "headway_envs.parallel_env:ParallelEnvBase",
        "call_km": f"{_REALISM}.comparison:call_km",
        "compare_replay": f"{_REALISM}.comparison:compare_replay",
        "from_batched": "headway_envs.parallel_env:from_batched",
        "headway_statistics": f"{_REALISM}.trip_statistics:headway_statistics",
        "link_loads": f"{_SCENARIO}.measures:link_loads",
        "plot_headways_along": f"{_REALISM}.plots:plot_headways_along",
        "plot_load_profile": f"{_REALISM}.plots:plot_load_profile",
        "plot_scenario": f"{_SCENARIO}.plots:plot_scenario",
        "plot_time_space": f"{_REALISM}.plots:plot_time_space",
        "prepare": "headway_envs.bus.prepare:prepare",
        "prepare_replay": "headway_envs.bus.prepare:prepare_replay",
        "scenario_tables": f"{_SCENARIO}.source:scenario_tables",
        "simulated_days": f"{_REALISM}.calls:simulated_days",
        "write_sumo_scenario": "headway_envs.intersection.sumo.scenario:write_sumo_scenario",
    },
)

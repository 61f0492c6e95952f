"""Headway's environments by name. Importing this imports no compiled kernels and no data frames."""

from headway.contracts import EnvEntry
from headway_envs.bus.entry import ENTRY as BUS
from headway_envs.intersection.entry import ENTRY as INTERSECTION
from headway_envs.merge.entry import ENTRIES as MERGES
from headway_envs.toy.entry import ENTRIES as TOYS

ENTRIES: dict[str, EnvEntry] = {"bus": BUS, "intersection": INTERSECTION, **MERGES, **TOYS}

"""Registry of Headway's environments by name. Importing it imports no compiled kernels and no data frames."""

from headway.contracts import EnvEntry
from headway_envs.bus.entry import ENTRY as BUS
from headway_envs.bus_published.entry import ENTRY as BUS_PUBLISHED
from headway_envs.intersection.entry import ENTRY as INTERSECTION
from headway_envs.junctions.entry import ENTRY as JUNCTIONS
from headway_envs.merge.entry import ENTRIES as MERGES
from headway_envs.toy.entry import ENTRIES as TOYS

ENTRIES: dict[str, EnvEntry] = {
    "bus": BUS,
    "bus_published": BUS_PUBLISHED,
    "intersection": INTERSECTION,
    "junctions": JUNCTIONS,
    **MERGES,
    **TOYS,
}
"""Every environment of Headway by name."""

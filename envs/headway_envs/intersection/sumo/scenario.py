"""Episodes of the intersection as files that SUMO runs by itself."""

import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from headway.contracts import generator
from headway_envs.intersection.config import STEP_S, IntersectionConfig
from headway_envs.intersection.demand import routes_xml
from headway_envs.intersection.network import network_file
from headway_envs.sumo_simulation import COMMON_OPTIONS

OPTIONS = {"step-length": str(STEP_S), **COMMON_OPTIONS}
"""SUMO's options besides network, routes and seed."""


def episode_draws(seed: int, episode: int) -> tuple[int, np.random.Generator]:
    """Return SUMO's seed of an episode, and the generator of the noise of human drivers."""
    draw = generator(seed, "intersection", episode)
    return int(draw.integers(2**31 - 1)), draw


def write_sumo_scenario(config: IntersectionConfig, folder: str | Path, seed: int) -> Path:
    """Write network, routes and configuration of the episode that begins with `reset(seed)`, for SUMO alone.

    Returns the path of the configuration, `intersection.sumocfg` in `folder`, which is created if missing.
    SUMO then drives every vehicle until it is commanded.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(network_file(config.junction), folder / "intersection.net.xml")
    (folder / "intersection.rou.xml").write_text(routes_xml(config), encoding="utf-8")
    sumo_seed, _ = episode_draws(seed, 0)
    files = {"net-file": "intersection.net.xml", "route-files": "intersection.rou.xml"}
    root = ElementTree.Element("configuration")
    for name, value in {**files, **OPTIONS, "seed": str(sumo_seed)}.items():
        ElementTree.SubElement(root, name, value=value)
    ElementTree.indent(root)
    path = folder / "intersection.sumocfg"
    ElementTree.ElementTree(root).write(path, encoding="utf-8")
    return path

"""The environments work where NumPy, Numba, Gymnasium and PettingZoo are the only other packages."""

from pathlib import Path

from linked_packages import link_packages, run_with_packages

from headway_envs.registry import ENTRIES

WITH_MORE = {"intersection", "junctions", "bus_published"}
"""Environments that need more: SUMO, and pandas with SciPy."""
PROGRAM = """
import sys
from importlib.util import find_spec
assert not any(map(find_spec, ("pandas", "scipy", "yaml", "torch", "pyarrow", "matplotlib")))
from headway_envs.api import ENTRIES
for name in sys.argv[1:]:
    env = ENTRIES[name].parallel_env(ENTRIES[name].config())
    env.reset(seed=1)
    for _ in range(3):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    print(name)
"""


def test_environments_need_four_packages_and_what_these_require(tmp_path: Path) -> None:
    link_packages(tmp_path, ("numpy", "numba", "gymnasium", "pettingzoo"))
    names = [name for name in ENTRIES if name not in WITH_MORE]
    ended = run_with_packages(tmp_path, "-c", PROGRAM, *names)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.split() == names
